"""Pixels excluded by `masks/` or marked in `ignore/` are neither learned nor measured."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import glassplat.evaluate.evaluate
import glassplat.evaluate.metrics
from glassplat.captures.cameras import PixelMap
from glassplat.captures.dataset import load_dataset
from glassplat.captures.masks import Mask, read_transparent
from glassplat.captures.view import IgnoredFiles, MaskFile, PhotoFile, View
from glassplat.errors import InputError
from glassplat.evaluate.evaluate import evaluate
from glassplat.evaluate.truth import TrueSurface, TrueView
from glassplat.files.sidecars import write_planes
from glassplat.panes.material import compared_region, reduced_photograph
from glassplat.render.frame import Frame
from glassplat.render.planar import Planar
from glassplat.training.losses import PhotometricLoss
from tests.render.tiny_scene import camera_at
from tests.training.tiny_capture import tiny_capture, true_scene, write_tiny_capture


def write_ignored(root: Path, name: str, box: tuple[slice, slice], size: tuple[int, int] = (28, 40)) -> None:
    (root / "ignore").mkdir(exist_ok=True)
    mask = np.zeros(size, dtype=np.uint8)
    mask[box] = 255
    Image.fromarray(mask).save(root / "ignore" / name)


def somewhere() -> torch.Tensor:
    """[28, 40] the pixels of a passer-by."""
    ignored = torch.zeros(28, 40, dtype=torch.bool)
    ignored[5:20, 8:18] = True
    return ignored


def test_ignore_masks_are_read_in_addition_to_pane_masks(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    write_ignored(root, "1.png", (slice(0, 10), slice(0, 20)))
    write_ignored(root, "2_mask.png", (slice(0, 28), slice(30, 40)))
    dataset = load_dataset(root)
    views = {view.name: view for view in (*dataset.train, *dataset.test)}
    assert views["3.png"].ignored is None and views["1.png"].pane_labels is not None
    first, second = views["1.png"].ignored, views["2.png"].ignored
    assert first is not None and second is not None
    assert bool(first[:10, :20].all()) and int(first.sum()) == 200
    assert bool(second[:, 30:].all()) and int(second.sum()) == 280


@pytest.mark.parametrize("size", [(40, 28), (25, 18), (20, 14), (13, 9)])
def test_excluded_pixels_do_not_bleed_into_a_reduced_photograph(size: tuple[int, int], tmp_path: Path) -> None:
    rows, columns = np.mgrid[:28, :40]
    inside = (rows - 13.3) ** 2 + (columns - 19.1) ** 2 < 11.0**2
    path, pixel_map = tmp_path / "0.png", PixelMap(None, *size)
    Image.fromarray(np.where(inside[..., None], np.uint8([200, 180, 160, 255]), np.uint8([0, 0, 0, 0]))).save(path)
    ignored = IgnoredFiles((MaskFile(Mask(path, read_transparent), (40, 28), pixel_map),))()
    kept = PhotoFile(path, pixel_map, None)()[ignored == 0]
    assert len(kept) > 0.4 * inside.sum() * size[0] * size[1] / inside.size
    assert kept.unique(dim=0).tolist() == [[200, 180, 160]]


def ignored_of(root: Path) -> dict[str, torch.Tensor]:
    data = load_dataset(root)
    return {v.name: v.ignored for v in (*data.train, *data.test) if v.ignored is not None}


def write_shades(path: Path, shades: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(shades).save(path)


KEPT = np.full((28, 40), 255, dtype=np.uint8)
KEPT[5:20, 8:18] = 0
DROPPED = torch.from_numpy(KEPT == 0)


@pytest.mark.parametrize(
    "name", ["masks/1.png.png", "masks/1.png", "masks/1_mask.png", "masks/1.jpg", "images/1_mask.png"]
)
def test_black_mask_pixels_are_excluded_for_any_mask_name(tmp_path: Path, name: str) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    write_shades(root / name, KEPT)
    found = ignored_of(root)
    assert list(found) == ["1.png"] and torch.equal(found["1.png"], DROPPED)
    assert load_dataset(root).pane_labels == (1,), "the panes are those of panes/"


def test_masks_of_every_pixel_format_exclude_the_same_pixels(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    transparent = np.dstack([np.full((28, 40, 3), 90, dtype=np.uint8), KEPT])
    soft = KEPT.copy()
    soft[20, 8:18] = 200
    (root / "masks").mkdir()
    Image.fromarray(soft).quantize(4).save(root / "masks/0.png")
    for number, shades in enumerate([KEPT > 0, KEPT.astype(np.uint16) * 257, transparent], start=1):
        write_shades(root / f"masks/{number}.png", shades)
    found = ignored_of(root)
    assert sorted(found) == ["0.png", "1.png", "2.png", "3.png"]
    assert all(torch.equal(ignored, DROPPED) for ignored in found.values())


def test_masks_of_most_pixels_get_a_warning_and_of_all_pixels_are_refused(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    names = [path.name for path in (root / "images").iterdir()]
    write_shades(root / "masks/1.png", KEPT)
    assert not any("inverted" in text for text in load_dataset(root).warnings)
    for name in names:
        write_shades(root / "masks" / name, 255 - KEPT)
    assert any("exclude about 87% of the photographs: black" in text for text in load_dataset(root).warnings)
    for name in names:
        write_shades(root / "masks" / name, np.zeros_like(KEPT))
    with pytest.raises(InputError, match=r"all pixels of all photographs .* black in masks/ is ignored.* inverted\?"):
        load_dataset(root)
    write_shades(root / "masks" / names[-1], KEPT)
    assert any("inverted" in text for text in load_dataset(root).warnings)


def test_both_kinds_of_masks_exclude_pixels(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    write_shades(root / "masks/1.png", KEPT)
    write_ignored(root, "1.png", (slice(24, 28), slice(0, 40)))
    expected = DROPPED.clone()
    expected[24:] = True
    assert torch.equal(ignored_of(root)["1.png"], expected)


def test_frames_name_their_masks(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    write_shades(root / "kept/first.png", KEPT)
    settings = json.loads((root / "transforms.json").read_text())
    frame = next(frame for frame in settings["frames"] if frame["file_path"] == "images/1.png")
    frame["mask_path"] = "kept/first.png"
    (root / "transforms.json").write_text(json.dumps(settings))
    found = ignored_of(root)
    assert list(found) == ["1.png"] and torch.equal(found["1.png"], DROPPED)
    (root / "kept/first.png").unlink()
    with pytest.raises(InputError, match=r"mask_path .* names masks that are missing: .*first\.png"):
        load_dataset(root)


def name_mask(root: Path, file: str, mask: str = "masks/1.png") -> None:
    """Makes a transforms file name a mask of one photograph."""
    settings = json.loads((root / file).read_text())
    next(frame for frame in settings["frames"] if frame["file_path"] == "images/1.png")["mask_path"] = mask
    (root / file).write_text(json.dumps(settings))


def test_masks_named_by_frames_are_never_panes(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    shutil.rmtree(root / "panes")
    write_shades(root / "masks/1.png", KEPT > 0)
    name_mask(root, "transforms.json")
    assert load_dataset(root).pane_labels == () and torch.equal(ignored_of(root)["1.png"], DROPPED)


@pytest.mark.parametrize("mask", ["masks/mask_of_first.png", "masks/lens.png", "images/2_mask.png"])
def test_masks_that_frames_name_may_have_any_name(tmp_path: Path, mask: str) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    write_shades(root / mask, KEPT)
    name_mask(root, "transforms.json", mask)
    assert list(ignored_of(root)) == ["1.png"] and load_dataset(root).warnings == ()
    write_shades(root / "masks/elsewhere.png", KEPT)
    assert any("1 mask belongs to no photograph (elsewhere.png)" in text for text in load_dataset(root).warnings)


def test_frames_of_a_file_for_training_name_their_masks_too(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    (root / "transforms.json").rename(root / "transforms_train.json")
    write_shades(root / "masks/1.png", KEPT)
    (root / "masks").rename(root / "kept")
    name_mask(root, "transforms_train.json")
    with pytest.raises(InputError, match=r"mask_path of transforms_train.json .* missing"):
        load_dataset(root)
    (root / "kept").rename(root / "masks")
    assert torch.equal(ignored_of(root)["1.png"], DROPPED)


def test_masks_of_photographs_without_a_pose_are_mentioned(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    write_shades(root / "masks/1.png", KEPT)
    write_shades(root / "masks/elsewhere.png", KEPT)
    assert any("1 mask belongs to no photograph (elsewhere.png)" in text for text in load_dataset(root).warnings)
    (root / "masks/1.png").unlink()
    with pytest.raises(InputError, match=r"match no photograph: elsewhere\.png"):
        load_dataset(root)


def test_a_capture_of_an_earlier_version_keeps_its_panes_with_one_message(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    now = load_dataset(root)
    (root / "panes").rename(root / "masks")
    before = load_dataset(root)
    assert before.pane_labels == now.pane_labels == (1,)
    for old, new in zip(before.train, now.train, strict=True):
        assert old.ignored is None and torch.equal(old.pane_labels, new.pane_labels)
    assert [text for text in before.warnings if "rename it to panes/" in text] == list(before.warnings)
    shutil.copy(next((root / "masks").iterdir()), root / "masks" / "elsewhere.png")
    assert any("1 mask belongs to no photograph (elsewhere.png)" in text for text in load_dataset(root).warnings)


def test_black_and_white_panes_of_earlier_versions_are_recognised_by_their_planes(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    shutil.rmtree(root / "panes")
    write_shades(root / "masks/1.png", 255 - KEPT)
    assert load_dataset(root).pane_labels == () and len(ignored_of(root)) == 1
    write_planes(root / "planes.json", true_scene().planes)
    assert load_dataset(root).pane_labels == (1,) and not ignored_of(root)


def test_labels_of_panes_in_both_folders_are_refused(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    shutil.copytree(root / "panes", root / "masks")
    with pytest.raises(InputError, match=r"no value above 1, as if they were labels of panes"):
        load_dataset(root)


def test_masked_pixels_have_no_gradient(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    write_shades(root / "masks/1.png.png", KEPT)
    view = next(view for view in load_dataset(root).train if view.name == "1.png")
    image = torch.rand(28, 40, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    (gradient,) = torch.autograd.grad(PhotometricLoss(0.2)(Frame(image), view, true_scene()), image)
    assert not bool(gradient[DROPPED].any()) and bool(gradient[~DROPPED].any(dim=1).all())


def test_masks_without_a_photograph_are_refused(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    write_ignored(root, "passer-by.png", (slice(0, 1), slice(0, 1)))
    with pytest.raises(InputError, match=r"masks in .*ignore match no photograph: passer-by\.png"):
        load_dataset(root)


def test_masks_are_reduced_with_their_photographs(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    write_ignored(root, "1.png", (slice(0, 14), slice(0, 40)))
    view = next(view for view in load_dataset(root, downscale=2).train if view.name == "1.png")
    assert view.ignored is not None
    assert view.ignored[:7].all() and not view.ignored[7:].any()


def test_ignored_pixels_have_no_gradient_and_no_loss() -> None:
    view = tiny_capture().train[0]
    ignoring = replace(view, read_ignored=somewhere)
    right = view.photo.float() / 255
    wrong = torch.where(somewhere()[..., None], 1 - right, right)
    loss = PhotometricLoss(0.2)
    assert float(loss(Frame(wrong), ignoring, true_scene())) == pytest.approx(0, abs=1e-6)
    assert float(loss(Frame(wrong), view, true_scene())) > 0.05
    image = torch.rand(28, 40, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(Frame(image), ignoring, true_scene()), image)
    assert not bool(gradient[somewhere()].any()) and bool(gradient[~somewhere()].any())


def test_metrics_leave_ignored_pixels_out() -> None:
    dataset = tiny_capture()
    view = dataset.test[0]
    spoilt = view.photo.clone()
    spoilt[somewhere()] = 255 - spoilt[somewhere()]
    passed = View.in_memory(view.name, view.camera, photo=spoilt)

    def measured(view: View) -> dict:
        return evaluate(true_scene(), Planar(), replace(dataset, test=(view,))).results

    clean, passed_by, ignoring = (measured(v) for v in (view, passed, replace(passed, read_ignored=somewhere)))
    for name in ("psnr", "corrected_psnr", "right_half_psnr"):
        assert passed_by[name] < clean[name] - 5
        assert ignoring[name] == pytest.approx(clean[name], abs=3.0)
    assert ignoring["ssim"] > passed_by["ssim"] + 0.02
    nothing = measured(replace(passed, read_ignored=lambda: torch.ones(28, 40, dtype=torch.bool)))
    assert nothing["psnr"] is None and "ignored" in nothing["psnr_reason"]


def test_metrics_of_layers_leave_ignored_pixels_out(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = tiny_capture()
    view = dataset.test[0]
    layers = Planar()(true_scene(), view.camera).layers
    through, mirrored = (
        (255 * layers[name].detach().clamp(0, 1)).to(torch.uint8) for name in ("transmission", "reflection")
    )
    labels = torch.ones(28, 40, dtype=torch.uint8)

    def measured(spoil: bool, ignored: bool) -> dict:
        shown = [torch.where(somewhere()[..., None], 255 - x, x) if spoil else x for x in (through, mirrored)]
        truth = SimpleNamespace(view=lambda *_: TrueView(*shown, torch.full((28, 40), 0.1), labels), planes=())
        monkeypatch.setattr(glassplat.evaluate.evaluate, "load_truth", lambda path: truth)
        seen = replace(view, read_ignored=somewhere) if ignored else view
        return evaluate(true_scene(), Planar(), replace(dataset, test=(seen,))).results

    clean, spoilt, ignoring = measured(False, True), measured(True, False), measured(True, True)
    for name in ("transmission_psnr", "reflection_psnr"):
        assert spoilt[name] < clean[name] - 5
        assert ignoring[name] == pytest.approx(clean[name])


def test_metrics_of_surfaces_leave_ignored_pixels_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = tiny_capture()
    view = replace(dataset.test[0], read_ignored=somewhere)
    everywhere = TrueSurface(torch.ones(28, 40, dtype=torch.bool), None, torch.ones(28, 40))
    monkeypatch.setattr(glassplat.evaluate.evaluate, "true_surface", lambda view: everywhere)
    spoilt = torch.where(somewhere()[..., None], 255 - view.photo, view.photo)
    passed = replace(View.in_memory(view.name, view.camera, photo=spoilt), read_ignored=somewhere)
    clean, passed_by = (evaluate(true_scene(), Planar(), replace(dataset, test=(v,))).results for v in (view, passed))
    assert passed_by["reflective_psnr"] == pytest.approx(clean["reflective_psnr"])


def test_the_right_half_begins_in_the_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = tiny_capture()
    view = dataset.test[0]
    with torch.no_grad():
        almost = torch.round(Planar()(true_scene(), view.camera).rgb.clamp(0, 0.99) * 255 + 1).to(torch.uint8)
    almost[:, view.camera.width // 2 - 1] = 255
    monkeypatch.setattr(glassplat.evaluate.metrics, "correct_colors", lambda image, *rest, **more: image)
    spoilt = View.in_memory(view.name, view.camera, photo=almost)
    results = evaluate(true_scene(), Planar(), replace(dataset, test=(spoilt,))).results
    assert results["psnr"] < 40 < 45 < results["right_half_psnr"]


def test_ignored_pixels_are_no_evidence_for_mirrors() -> None:
    view = tiny_capture().train[0]
    camera = replace(camera_at(0.0, 0.0, -0.3), cam_from_world=camera_at(0.0, 0.0, -0.3).cam_from_world.float())
    solid = true_scene().primary
    opaque = solid.with_tensors(
        {"logit_opacities": torch.full((len(solid),), 5.0), "log_scales": solid.log_scales + 1.5}
    )
    scene = replace(true_scene(), primary=opaque)
    view = View.in_memory("x", camera, photo=view.photo, pane_labels=torch.ones(28, 40, dtype=torch.uint8))
    views = (view, replace(view, read_ignored=somewhere))
    some, fewer = (int(compared_region(scene, reduced_photograph(scene, v))[-1].sum()) for v in views)
    assert 0 < fewer < some
