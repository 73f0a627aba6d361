"""Published captures of shiny objects: Shiny Blender and NeRF-synthetic folders, and Ref-Real's COLMAP folders."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from glassplat.captures.dataset import Dataset, load_dataset

LAYOUTS = {
    "Shiny Blender": (("train", "test"), ("_normal.png", "_alpha.png", "_disp.tiff")),
    "NeRF-synthetic": (("train", "val", "test"), ("_depth_0001.png", "_normal_0001.png")),
}
MASK_LIKE = np.zeros((24, 32), dtype=np.uint8)
MASK_LIKE[6:18, 8:24] = 255


def write_blender(capture, parts: tuple[str, ...], beside_test: tuple[str, ...]) -> None:
    """The same names in every part, file_path without suffix, and further files next to the test photographs."""
    capture.names = [f"r_{index}.png" for index in range(len(capture.names))]
    for part in parts:
        capture.write_images("RGBA", part)
        frames = [
            {**frame, "file_path": frame["file_path"].removesuffix(".png"), "rotation": 0.0125}
            for frame in capture.frames(f"./{part}/")
        ]
        capture.write_transforms({"camera_angle_x": 0.69, "frames": frames}, file_name=f"transforms_{part}.json")
    for name in capture.names:
        for suffix in beside_test:
            capture.write_mask(f"test/{name.removesuffix('.png')}{suffix}", MASK_LIKE)


@pytest.fixture(params=LAYOUTS)
def blender(capture, request: pytest.FixtureRequest) -> Dataset:
    write_blender(capture, *LAYOUTS[request.param])
    return load_dataset(capture.root)


def test_photographs_of_both_parts_keep_names_of_their_own(blender: Dataset) -> None:
    names = [f"r_{index}.png" for index in range(10)]
    assert [view.name for view in blender.train] == [f"train/{name}" for name in names]
    assert [view.name for view in blender.test] == [f"test/{name}" for name in names]
    assert [view.image_path.name for view in blender.test] == names
    assert blender.split == "shipped with the data"


def test_files_next_to_a_photograph_are_no_masks(blender: Dataset) -> None:
    assert blender.pane_labels == ()
    assert not any(view.is_annotated for view in (*blender.train, *blender.test))


def test_objects_without_points_start_from_random_points_in_their_box(blender: Dataset) -> None:
    positions = blender.points.positions
    assert len(positions) == 100_000
    assert 1.29 < positions.abs().max() <= 1.3
    assert not blender.measured_points


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_objects_in_other_units_start_from_points_that_the_cameras_see(capture, unit: float) -> None:
    for pose in capture.poses:
        pose[:3, 3] *= unit
    write_blender(capture, *LAYOUTS[next(iter(LAYOUTS))])
    found = load_dataset(capture.root)
    reach = found.points.positions.norm(dim=1).amax() / unit
    assert 0.5 < reach < 10
    assert any("20000 random points" in warning for warning in found.warnings)


def test_transparent_photographs_are_laid_over_white(blender: Dataset) -> None:
    assert blender.background == (1.0, 1.0, 1.0)
    assert any("laid over sRGB (1.0, 1.0, 1.0)" in warning for warning in blender.warnings)


@pytest.mark.parametrize("downscale", [1.0, 2.0])
def test_reduced_copies_of_the_photographs_are_ignored(capture, downscale: float) -> None:
    capture.names = [f"_DSC{8700 + index}.JPG" for index in range(10)]
    capture.write_colmap()
    full = capture.size
    for factor in (2, 4, 8):
        capture.size = (full[0] // factor, full[1] // factor)
        capture.write_images(folder=f"images_{factor}")
    data = load_dataset(capture.root, downscale=downscale)
    assert [view.name for view in data.test] == ["_DSC8700.JPG", "_DSC8708.JPG"]
    assert len(data.train) == 8
    for view in (*data.train, *data.test):
        assert view.image_path.parent == capture.root / "images"
        assert (view.camera.width, view.camera.height) == (full[0] / downscale, full[1] / downscale)
        assert view.photo.shape == (view.camera.height, view.camera.width, 3)
    assert data.background is None and data.measured_points and not data.warnings
    assert torch.isfinite(data.points.positions).all()
