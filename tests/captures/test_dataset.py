"""Features common to all formats: detection, split, extent, downscaling, transparency, views in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from glassplat.captures.dataset import load_dataset
from glassplat.captures.view import View
from glassplat.errors import InputError
from tests.files.profiles import IN_P3, IN_SRGB, p3_profile


def test_every_eighth_image_by_name_is_held_out(capture) -> None:
    capture.names.reverse()
    capture.write_colmap()
    data = load_dataset(capture.root)
    assert [view.name for view in data.test] == ["0000.png", "0008.png"]
    assert [view.name for view in data.train] == [f"{i:04d}.png" for i in (1, 2, 3, 4, 5, 6, 7, 9)]
    assert data.split == "every 8th image by name"


def test_a_path_that_is_not_unicode_is_refused(capture) -> None:
    with pytest.raises(InputError, match=r"caf.* is not valid UTF-8; rename"):
        load_dataset(capture.root / "caf\udce9")


def test_extent_is_the_radius_of_the_training_cameras(capture) -> None:
    capture.write_colmap()
    data = load_dataset(capture.root)
    centers = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in capture.poses])[[1, 2, 3, 4, 5, 6, 7, 9]]
    radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert data.extent == pytest.approx(1.1 * radius, rel=1e-5)


def test_photographs_are_read_once_and_late(capture) -> None:
    capture.write_colmap()
    view = load_dataset(capture.root).train[0]
    stored = np.array(Image.open(view.image_path))
    np.testing.assert_array_equal(view.photo.numpy(), stored)
    view.image_path.unlink()
    assert view.photo is view.photo
    assert view.camera.cam_from_world.dtype == torch.float32


@pytest.mark.parametrize(("downscale", "size"), [(1.0, (32, 24)), (2.0, (16, 12)), (3.0, (11, 8)), (1.5, (21, 16))])
def test_downscaling_spans_the_same_image(capture, downscale: float, size: tuple[int, int]) -> None:
    capture.write_colmap()
    full = load_dataset(capture.root).train[0]
    view = load_dataset(capture.root, downscale=downscale).train[0]
    assert (view.camera.width, view.camera.height) == size
    assert tuple(view.photo.shape) == (size[1], size[0], 3)
    points = torch.from_numpy(capture.points).float()
    uv, depth = view.camera.project(points)
    full_uv, full_depth = full.camera.project(points)
    torch.testing.assert_close(uv / torch.tensor(size), full_uv / torch.tensor([32, 24]))
    torch.testing.assert_close(depth, full_depth)


def test_photographs_of_another_colour_space_are_read_in_srgb(capture) -> None:
    capture.write_colmap()
    path = capture.root / "images" / capture.names[1]
    Image.new("RGB", capture.size, IN_P3).save(path, icc_profile=p3_profile())
    (view,) = [view for view in load_dataset(capture.root).train if view.name == capture.names[1]]
    np.testing.assert_allclose(view.photo[3, 4].numpy(), IN_SRGB, atol=1)


def test_downscaling_averages_area(capture) -> None:
    capture.write_colmap()
    photo = load_dataset(capture.root).train[0].photo.double()
    small = load_dataset(capture.root, downscale=2.0).train[0].photo.double()
    averages = photo.reshape(12, 2, 16, 2, 3).mean(dim=(1, 3))
    assert (small - averages).abs().max() <= 0.5


@pytest.mark.parametrize(("background", "behind"), [((1.0, 1.0, 1.0), 255), ((0.0, 0.0, 0.0), 0)])
def test_transparent_pixels_show_the_background(capture, background, behind: int) -> None:
    capture.write_images("RGBA")
    capture.write_transforms({"fl_x": 30.0, "fl_y": 30.0, "w": 32, "h": 24, "frames": capture.frames()})
    data = load_dataset(capture.root, background=background)
    view = data.train[0]
    pixels = np.array(Image.open(view.image_path)).astype(float)
    alpha = pixels[:, :, 3:] / 255
    np.testing.assert_allclose(view.photo.numpy(), pixels[:, :, :3] * alpha + behind * (1 - alpha), atol=0.51)
    assert data.background == background
    assert any("transparent pixels" in warning for warning in data.warnings)


def test_transparent_pixels_of_colmap_captures_are_left_out(capture) -> None:
    capture.write_colmap()
    capture.write_images("RGBA")
    data = load_dataset(capture.root)
    for view in (*data.train, *data.test):
        pixels = np.array(Image.open(view.image_path))
        assert view.ignored is not None
        np.testing.assert_array_equal(view.ignored.numpy(), pixels[:, :, 3] < 128)
        np.testing.assert_array_equal(view.photo.numpy(), pixels[:, :, :3])
    assert data.background is None
    assert "Transparent pixels of the photographs are ignored." in data.warnings


def test_photographs_that_store_an_opaque_alpha_channel_are_opaque(capture) -> None:
    capture.write_colmap()
    for path in sorted((capture.root / "images").iterdir()):
        photo = Image.open(path).convert("RGB")
        photo.putalpha(255)
        photo.save(path.with_suffix(".png"))
    data = load_dataset(capture.root)
    assert data.background is None and all(view.ignored is None for view in data.train)
    assert not any("transparent pixels" in warning for warning in data.warnings)


def test_grey_photographs_have_three_equal_channels(capture) -> None:
    capture.write_colmap()
    capture.write_images("L")
    photo = load_dataset(capture.root).train[0].photo
    assert photo.shape[2] == 3
    assert torch.equal(photo[:, :, 0], photo[:, :, 2])


def test_truth_is_found_where_it_is(capture) -> None:
    capture.write_colmap()
    assert load_dataset(capture.root).truth is None
    (capture.root / "gt").mkdir()
    assert load_dataset(str(capture.root)).truth == capture.root / "gt"


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        load_dataset(tmp_path / "nowhere")


def test_an_unknown_format_is_refused_with_what_was_found(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Looked for: a COLMAP model .*transforms\.json.* Found: nothing"):
        load_dataset(tmp_path)
    (tmp_path / "scan.e57").write_text("")
    with pytest.raises(InputError, match=r"Found: scan\.e57"):
        load_dataset(tmp_path)


def test_a_photograph_that_would_be_reduced_to_nothing_is_refused(capture) -> None:
    capture.write_colmap()
    with pytest.raises(InputError, match=r" is 32x24 pixels, and 1x1 reduced by 1000; expected at least"):
        load_dataset(capture.root, downscale=1000.0)


@pytest.mark.parametrize("downscale", [0.5, 0.0, -1.0, float("nan"), float("inf")])
def test_downscale_out_of_range(capture, downscale: float) -> None:
    capture.write_colmap()
    with pytest.raises(InputError, match=r"downscale is .*at least 1"):
        load_dataset(capture.root, downscale=downscale)


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_photographs(capture, count: int) -> None:
    capture.names, capture.poses = capture.names[:count], capture.poses[:count]
    capture.write_colmap()
    with pytest.raises(InputError, match=r"left for training .*at least two"):
        load_dataset(capture.root)


@pytest.mark.parametrize(("own", "place"), [(0, [1.0, 2.0, 3.0]), (1, [5e7, 6e8, 0.0])])
def test_cameras_at_one_point(capture, own: float, place: list[float]) -> None:
    for pose in capture.poses:
        pose[:3, 3] = own * pose[:3, 3] - pose[:3, :3] @ place
    capture.write_colmap()
    with pytest.raises(InputError, match=r"at one point, \((1, 2, 3|.*e\+0[78], .*e\+08, .*)\), .*georeferenced"):
        load_dataset(capture.root)


def test_two_poses_for_one_photograph(capture) -> None:
    capture.names[3] = capture.names[2]
    capture.write_colmap()
    with pytest.raises(InputError, match=r"more than once: 0002\.png"):
        load_dataset(capture.root)


def test_coordinates_too_large_for_float32_are_mentioned(capture) -> None:
    for pose in capture.poses:
        pose[:3, 3] -= pose[:3, :3] @ [1e6, 0.0, 0.0]
    capture.points[:, 0] += 1e6
    capture.write_colmap()
    assert any("from the origin" in warning for warning in load_dataset(capture.root).warnings)


def test_view_in_memory(capture) -> None:
    capture.write_colmap()
    camera = load_dataset(capture.root).train[0].camera
    photo = torch.zeros(24, 32, 3, dtype=torch.uint8)
    labels = torch.ones(24, 32, dtype=torch.uint8)
    view = View.in_memory("rendered.png", camera, photo=photo, pane_labels=labels)
    assert view.photo is photo
    assert view.pane_labels is labels
    assert view.is_annotated
    assert View.in_memory("rendered.png", camera, photo=photo).pane_labels is None


def test_a_folder_with_a_too_long_name_counts_as_missing() -> None:
    with pytest.raises(FileNotFoundError, match="no folder"):
        load_dataset("a" * 5000)
