"""What `ignore/` marks is neither learned nor measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from glassplat.captures.dataset import load_dataset
from glassplat.captures.view import View
from glassplat.errors import InputError
from glassplat.evaluate.evaluate import evaluate
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


def test_masks_of_what_is_ignored_are_read_beside_those_of_panes(tmp_path: Path) -> None:
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


def test_masks_that_belong_to_no_photograph_are_refused(tmp_path: Path) -> None:
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
    nothing = measured(replace(passed, read_ignored=lambda: torch.ones(28, 40)))
    assert nothing["psnr"] is None and "ignored" in nothing["psnr_reason"]


def test_ignored_pixels_do_not_tell_mirrors_from_glass() -> None:
    view = tiny_capture().train[0]
    camera = replace(camera_at(0.0, 0.0, -0.3), cam_from_world=camera_at(0.0, 0.0, -0.3).cam_from_world.float())
    solid = true_scene().primary
    opaque = solid.with_tensors(
        {"logit_opacities": torch.full((len(solid),), 5.0), "log_scales": solid.log_scales + 1.5}
    )
    scene = replace(true_scene(), primary=opaque)
    view = View.in_memory("x", camera, photo=view.photo, pane_labels=torch.ones(28, 40, dtype=torch.uint8))
    views = (view, replace(view, read_ignored=somewhere))
    some, fewer = (int(compared_region(scene, reduced_photograph(scene, v)).sum()) for v in views)
    assert 0 < fewer < some
