"""Mirror-NeRF scenes in the layouts that its public readers expect."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from glassplat.captures.colmap import load_colmap
from glassplat.captures.dataset import load_dataset
from glassplat.captures.mirror_nerf import load_mirror_nerf
from glassplat.errors import InputError

MIRROR = np.array([0.1, 0.2, 0.05])
OPENGL_TO_OPENCV = [1, -1, -1, 1]
MATRIX = [[30.0, 0, 16], [0, 31.0, 12], [0, 0, 1]]


def mirror_mask(capture, index: int) -> np.ndarray:
    """White around the pixel that shows the mirror's centre."""
    x, y, z = capture.poses[index][:3, :3] @ MIRROR + capture.poses[index][:3, 3]
    width, height = capture.size
    u, v = round(30 * width / 32 * x / z + width / 2), round(30 * width / 32 * y / z + height / 2)
    pixels = np.zeros((height, width), dtype=np.uint8)
    pixels[max(v - 4, 0) : v + 4, max(u - 5, 0) : u + 5] = 255
    return pixels


def write_real(capture, *, axes: str = "opengl", parts: dict[str, slice] | None = None, **settings: Any) -> None:
    """`frame_00000.jpg` in `images/`, masks of the same names, an explicit split, a matrix per frame."""
    capture.names = [f"frame_{i:05d}.jpg" for i in range(10)]
    capture.write_images()
    for index, name in enumerate(capture.names):
        capture.write_mask(f"masks/{name}", mirror_mask(capture, index), quality=95)
    frames = [frame | {"intrinsics": MATRIX} for frame in capture.frames()]
    if axes == "opencv":
        for frame in frames:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) * OPENGL_TO_OPENCV).tolist()
    for part, which in (parts or {"train": slice(0, 7), "val": slice(7, 8), "test": slice(8, 10)}).items():
        capture.write_transforms({**settings, "frames": frames[which]}, file_name=f"transforms_{part}.json")


def test_the_split_and_the_masks_of_a_real_scene(capture) -> None:
    write_real(capture)
    data = load_dataset(capture.root)
    assert [view.name for view in data.train] == [f"frame_{i:05d}.jpg" for i in range(7)]
    assert [view.name for view in data.test] == ["frame_00008.jpg", "frame_00009.jpg"]
    assert data.split == "shipped with the data"
    assert data.pane_labels == (1,)
    assert not data.measured_points
    assert all(view.is_annotated for view in (*data.train, *data.test))
    np.testing.assert_array_equal(data.train[3].pane_labels.numpy(), mirror_mask(capture, 3) > 0)


@pytest.mark.parametrize("axes", ["opengl", "opencv"])
def test_same_cameras_as_colmap_in_either_axes(capture, axes: str) -> None:
    write_real(capture, axes=axes)
    found = load_mirror_nerf(capture.root)
    capture.lenses = [("PINHOLE", [30.0, 31.0, 16.0, 12.0])]
    capture.write_colmap()
    expected = load_colmap(capture.root)
    assert found is not None and expected is not None
    assert found.test_shots is not None
    for mine, other in zip((*found.shots, *found.test_shots), [*expected.shots[:7], *expected.shots[8:]], strict=True):
        np.testing.assert_allclose(mine.cam_from_world, other.cam_from_world, atol=1e-9)
        assert mine.lens.parameters == other.lens.parameters
    assert any("OpenCV axes" in warning for warning in found.warnings) == (axes == "opencv")


def test_poses_that_fit_neither_axes_are_refused(capture) -> None:
    write_real(capture)
    capture.poses = [np.linalg.inv(pose) for pose in capture.poses]
    capture.poses[1][:3, 3] += 3.0
    frames = [frame | {"intrinsics": MATRIX} for frame in capture.frames()]
    for frame in frames:
        turn = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ turn).tolist()
    capture.write_transforms({"frames": frames[:7]}, file_name="transforms_train.json")
    with pytest.raises(InputError, match=r"masks lie in front of the cameras neither .*camera-to-world"):
        load_dataset(capture.root)


def test_axes_are_assumed_without_evidence(capture) -> None:
    write_real(capture)
    for name in capture.names[2:]:
        (capture.root / "masks" / name).unlink()
    data = load_dataset(capture.root)
    assert [view.is_annotated for view in data.train] == [True, True, False, False, False, False, False]
    assert any("OpenGL is assumed" in warning for warning in data.warnings)


def test_points_determine_the_axes_if_there_are_too_few_masks(capture) -> None:
    write_real(capture, axes="opencv")
    for name in capture.names[2:]:
        (capture.root / "masks" / name).unlink()
    capture.reconstruction().export_PLY(capture.root / "points3d.ply")
    data = load_dataset(capture.root)
    assert data.measured_points
    assert any("of the points lie in front" in warning for warning in data.warnings)


def test_intrinsics_of_the_file_at_the_size_before_reduction(capture) -> None:
    capture.size = (16, 12)
    write_real(capture)
    for part, which in (("train", slice(0, 7)), ("test", slice(8, 10))):
        frames = capture.frames()[which]
        capture.write_transforms(
            {"fx": 30.0, "cx": 15.9, "cy": 12.0, "frames": frames}, file_name=f"transforms_{part}.json"
        )
    lens = load_dataset(capture.root).train[0].camera
    assert (lens.width, lens.height) == (16, 12)
    assert lens.fx == pytest.approx(30 * 16 / 31.8)
    assert lens.cx == pytest.approx(8.0)


def test_a_measured_principal_point_stays(capture) -> None:
    matrix = [[30.0, 0, 15.5], [0, 31.0, 12.3], [0, 0, 1]]
    write_real(capture)
    capture.write_transforms(
        {"frames": [frame | {"intrinsics": matrix} for frame in capture.frames()[:7]]},
        file_name="transforms_train.json",
    )
    camera = load_dataset(capture.root).train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((30, 31, 15.5, 12.3))


def test_a_synthetic_scene(capture) -> None:
    """Opening angle, no suffixes, a folder per part, masks with their own names."""
    names = [f"Image_{i:04d}.png" for i in range(10)]
    for part, which in (("train", slice(0, 8)), ("test", slice(8, 10))):
        capture.names = names
        capture.write_images(folder=part)
        frames = capture.frames(f"./{part}/")[which]
        for frame in frames:
            frame["file_path"] = frame["file_path"].removesuffix(".png")
        angle = 2 * np.arctan(16 / 30)
        capture.write_transforms({"camera_angle_x": angle, "frames": frames}, file_name=f"transforms_{part}.json")
    for index in range(10):
        grey = np.minimum(mirror_mask(capture, index), 200)
        capture.write_mask(f"masks/MirrorMask_{index:04d}.png", grey)
    data = load_dataset(capture.root)
    assert [view.name for view in data.test] == ["test/Image_0008.png", "test/Image_0009.png"]
    np.testing.assert_array_equal(data.test[0].pane_labels.numpy(), mirror_mask(capture, 8) > 0)
    assert data.train[0].camera.fx == pytest.approx(30)


def test_masks_split_their_greys_at_one_half(capture) -> None:
    write_real(capture)
    capture.root.joinpath("masks", "frame_00000.jpg").unlink()
    ramp = np.tile(np.arange(32, dtype=np.uint8) * 8, (24, 1))
    capture.write_mask("masks/frame_00000.png", ramp)
    np.testing.assert_array_equal(load_dataset(capture.root).train[0].pane_labels.numpy(), ramp >= 128)


def test_the_validation_split_replaces_a_missing_test_split(capture) -> None:
    write_real(capture, parts={"train": slice(0, 8), "val": slice(6, 10)})
    data = load_dataset(capture.root)
    assert len(data.train) == 6 and len(data.test) == 4
    assert any("Not trained on: 2 photographs of the test split" in warning for warning in data.warnings)


def test_photographs_without_their_folder_are_found_in_images(capture) -> None:
    write_real(capture)
    frames = [frame | {"intrinsics": MATRIX} for frame in capture.frames(prefix="")]
    capture.write_transforms({"frames": frames[:7]}, file_name="transforms_train.json")
    assert load_dataset(capture.root).train[0].name == "frame_00000.jpg"


def test_folders_that_are_no_mirror_nerf_scene_are_not_claimed(capture) -> None:
    assert load_mirror_nerf(capture.root) is None
    write_real(capture)
    (capture.root / "masks").rename(capture.root / "elsewhere")
    assert load_mirror_nerf(capture.root) is None


def test_masks_of_what_to_keep_make_no_mirror_nerf_scene(capture) -> None:
    """Blender's captures have a validation part too, and masks of panes are stored in their own folder."""
    write_real(capture)
    assert load_mirror_nerf(capture.root) is not None
    (capture.root / "panes").mkdir()
    assert load_mirror_nerf(capture.root) is None
    (capture.root / "panes").rmdir()
    capture.write_transforms({"camera_angle_x": 0.7, "frames": capture.frames()[:7]}, file_name="transforms_train.json")
    assert load_mirror_nerf(capture.root) is None


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[1.0]], "expected a 3x3 matrix"),
        ("wide", "expected a 3x3 matrix"),
        ([[30.0, 0, 12], [0, 30.0, 16], [0, 0, 1]], "rotated or cropped"),
    ],
)
def test_intrinsics_that_cannot_be_used(capture, matrix: Any, message: str) -> None:
    write_real(capture)
    frames = [frame | {"intrinsics": matrix} for frame in capture.frames()[:7]]
    capture.write_transforms({"frames": frames}, file_name="transforms_train.json")
    with pytest.raises(InputError, match=message):
        load_dataset(capture.root)


def test_masks_of_other_photographs(capture) -> None:
    write_real(capture)
    for path in (capture.root / "masks").iterdir():
        path.rename(path.with_name(f"other_{path.name}"))
    with pytest.raises(InputError, match=r"none of the 10 files .*has the name of a photograph"):
        load_dataset(capture.root)


def test_unreadable_photograph(capture) -> None:
    write_real(capture)
    (capture.root / "images" / capture.names[0]).write_text("no image")
    with pytest.raises(InputError, match=r"frame_00000\.jpg"):
        load_dataset(capture.root)
