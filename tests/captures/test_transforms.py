"""`transforms.json` in its dialects; COLMAP's loader provides the expected result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from glassplat.captures.capture import Capture
from glassplat.captures.colmap import load_colmap
from glassplat.captures.dataset import load_dataset
from glassplat.captures.transforms import load_transforms
from glassplat.errors import InputError

LENS: dict[str, Any] = {"fl_x": 30.0, "fl_y": 31.0, "cx": 15.0, "cy": 12.5, "w": 32, "h": 24}


def load(capture, **settings: Any) -> Capture:
    capture.write_images()
    capture.write_transforms({**LENS, "frames": capture.frames(), **settings})
    found = load_transforms(capture.root)
    assert found is not None
    return found


def parameters_of(found: Capture) -> list[float]:
    return [float(value) for value in found.shots[0].lens.parameters]


def test_same_cameras_as_colmap(capture) -> None:
    found = load(capture)
    capture.lenses = [("PINHOLE", [30.0, 31.0, 15.0, 12.5])]
    capture.write_colmap()
    expected = load_colmap(capture.root)
    assert expected is not None
    assert [shot.name for shot in found.shots] == capture.names
    for mine, other in zip(found.shots, expected.shots, strict=True):
        np.testing.assert_allclose(mine.cam_from_world, other.cam_from_world, atol=1e-9)
        assert mine.lens.parameters == other.lens.parameters
        assert mine.image_path == other.image_path


@pytest.mark.parametrize(
    ("settings", "model", "parameters"),
    [
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, "OPENCV", [30, 31, 15, 12.5, 0.1, 0.2, 0.3, 0.4]),
        ({"k1": 0.1, "k3": 0.2}, "FULL_OPENCV", [30, 31, 15, 12.5, 0.1, 0, 0, 0, 0.2, 0, 0, 0]),
        ({"k1": 0.1, "k4": 0.2, "is_fisheye": True}, "OPENCV_FISHEYE", [30, 31, 15, 12.5, 0.1, 0, 0, 0.2]),
        ({"camera_model": "OPENCV_FISHEYE", "k2": 0.2}, "OPENCV_FISHEYE", [30, 31, 15, 12.5, 0, 0.2, 0, 0]),
        ({"camera_model": "PINHOLE", "w": 32.0}, "PINHOLE", [30, 31, 15, 12.5]),
        ({"distortion_params": [0.1, 0.2, 0, 0, 0.3, 0.4]}, "OPENCV", [30, 31, 15, 12.5, 0.1, 0.2, 0.3, 0.4]),
        (
            {"distortion_params": [0.1, 0, 0, 0.2, 0, 0], "is_fisheye": True},
            "OPENCV_FISHEYE",
            [30, 31, 15, 12.5, 0.1, 0, 0, 0.2],
        ),
    ],
)
def test_distortion_chooses_the_model(capture, settings: dict, model: str, parameters: list[float]) -> None:
    found = load(capture, **settings)
    assert found.shots[0].lens.model == model
    assert parameters_of(found) == pytest.approx(parameters)


def test_opening_angle_and_middle_are_the_fallback(capture) -> None:
    capture.write_images()
    capture.write_transforms({"camera_angle_x": 1.2, "frames": capture.frames()})
    found = load_transforms(capture.root)
    assert found is not None
    focal = 16 / math.tan(0.6)
    assert parameters_of(found) == pytest.approx([focal, focal, 16, 12])
    capture.write_transforms({"frames": capture.frames()})
    with pytest.raises(InputError, match=r"the lens of 0000\.png has no focal length; expected fl_x"):
        load_transforms(capture.root)


def test_second_opening_angle_is_used(capture) -> None:
    capture.write_images()
    capture.write_transforms({"camera_angle_x": 1.2, "camera_angle_y": 0.8, "frames": capture.frames()})
    found = load_transforms(capture.root)
    assert found is not None
    assert parameters_of(found)[:2] == pytest.approx([16 / math.tan(0.6), 12 / math.tan(0.4)])


def test_frame_overrides_the_file(capture) -> None:
    frames = capture.frames()
    frames[3] |= {"fl_x": 50.0, "fl_y": 50.0}
    found = load(capture, frames=frames)
    assert [shot.lens.parameters[0] for shot in found.shots] == [30, 30, 30, 50, 30, 30, 30, 30, 30, 30]


def test_blender_scene(capture) -> None:
    """Separate files, no suffix, only an opening angle, transparency."""
    for folder in ("train", "test"):
        capture.write_images("RGBA", folder)
    for folder in ("train", "test"):
        frames = capture.frames(f"./{folder}/")
        for frame in frames:
            frame["file_path"] = frame["file_path"].removesuffix(".png")
        capture.write_transforms({"camera_angle_x": 0.7, "frames": frames}, file_name=f"transforms_{folder}.json")
    data = load_dataset(capture.root)
    assert [view.name for view in data.train] == [f"train/{name}" for name in capture.names]
    assert [view.name for view in data.test] == [f"test/{name}" for name in capture.names]
    assert data.split == "shipped with the data"
    assert len(data.points) == 100_000
    assert 1.29 < data.points.positions.abs().max() <= 1.3
    assert any("transparent pixels" in warning for warning in data.warnings)


def test_train_file_alone_is_split(capture) -> None:
    capture.write_images()
    capture.write_transforms({**LENS, "frames": capture.frames()}, file_name="transforms_train.json")
    data = load_dataset(capture.root)
    assert [view.name for view in data.test] == ["0000.png", "0008.png"]


def test_split_named_in_the_file(capture) -> None:
    names = [f"images/{name}" for name in capture.names]
    found = load(capture, train_filenames=names[:6], val_filenames=names[6:9])
    assert [shot.name for shot in found.shots] == capture.names[:6]
    assert found.test_shots is not None
    assert [shot.name for shot in found.test_shots] == capture.names[6:9]
    assert "Ignored: 1 photograph in neither" in found.warnings[0]


@pytest.mark.parametrize("prefix", ["images/", "./images/", ".\\images\\", "images/../images/"])
def test_a_split_with_one_side_alone(capture, prefix: str) -> None:
    names = [f"{prefix}{name}" for name in capture.names]
    found = load(capture, test_filenames=names[:3])
    assert [shot.name for shot in found.test_shots or ()] == capture.names[:3]
    assert [shot.name for shot in found.shots] == capture.names[3:] and not found.warnings
    found = load(capture, train_filenames=names[:6], test_filenames=[])
    assert [shot.name for shot in found.shots] == capture.names[:6] and found.test_shots == ()
    assert "Ignored: 4 photographs in neither" in found.warnings[0]
    data = load_dataset(capture.root)
    assert (len(data.train), len(data.test)) == (6, 0)


def test_split_that_names_no_frame(capture) -> None:
    with pytest.raises(InputError, match=r"names photographs that have no frame: nothing.png"):
        load(capture, train_filenames=["nothing.png"], test_filenames=["images/0001.png"])


def test_null_is_an_absent_field(capture) -> None:
    frames = [frame | {"mask_path": None, "fl_x": None, "camera_angle_x": None} for frame in capture.frames()]
    nulls = dict.fromkeys(("applied_transform", "ply_file_path", "train_filenames", "k1", "distortion_params"))
    found, expected = load(capture, frames=frames, **nulls), load(capture)
    assert found is not None and expected is not None
    assert [shot.lens for shot in found.shots] == [shot.lens for shot in expected.shots]


@pytest.mark.parametrize("prior", ["depth_file_path", "normal_file_path"])
def test_priors_that_are_not_used_are_named(capture, prior: str) -> None:
    frames = capture.frames()
    frames[0][prior] = "elsewhere/0000.png"
    assert any(f"{prior} of 1 frame is left out" in warning for warning in load(capture, frames=frames).warnings)
    assert not any("left out" in warning for warning in load(capture).warnings)


@pytest.mark.parametrize("name", ["points3d.ply", "sparse_pc.ply", "cloud.ply"])
@pytest.mark.parametrize("binary", [True, False])
def test_points_next_to_the_file_are_read(capture, name: str, binary: bool) -> None:
    settings = {"ply_file_path": name} if name == "cloud.ply" else {}
    capture.root.mkdir()
    path = capture.root / name
    capture.reconstruction().export_PLY(path)
    if not binary:
        rows = [
            f"{x} {y} {z} {r} {g} {b}"
            for (x, y, z), (r, g, b) in zip(capture.points.tolist(), capture.colors.tolist(), strict=True)
        ]
        properties = [
            *(f"property double {n}" for n in "xyz"),
            *(f"property uchar {n}" for n in ("red", "green", "blue")),
        ]
        header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
        path.write_text("\n".join([*header, *rows, ""]))
    points = load(capture, **settings).points
    assert points is not None
    order = np.lexsort(points.positions.astype(float).T)
    expected = np.lexsort(capture.points.T)
    np.testing.assert_allclose(points.positions[order], capture.points[expected], atol=1e-6)
    np.testing.assert_array_equal(points.colors[order], capture.colors[expected])


@pytest.mark.parametrize("names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), "rgb"])
def test_points_may_have_colours_as_shares(names: Sequence[str], capture) -> None:
    capture.root.mkdir()
    header = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {n}" for n in "xyz")]
    header += [*(f"property float {n}" for n in names), "end_header"]
    (capture.root / "cloud.ply").write_text("\n".join([*header, "0 0 0 1 0.4 0", "1 1 1 0 0.2 1", ""]))
    points = load(capture, ply_file_path="cloud.ply").points
    assert points is not None
    np.testing.assert_array_equal(points.colors, [[255, 102, 0], [0, 51, 255]])


def test_points_without_colours_are_grey(capture) -> None:
    capture.root.mkdir()
    header = ["ply", "format ascii 1.0", "element vertex 1", *(f"property float {n}" for n in "xyz"), "end_header"]
    (capture.root / "points3d.ply").write_text("\n".join([*header, "0 1 2", ""]))
    points = load(capture).points
    assert points is not None and points.positions.tolist() == [[0, 1, 2]]
    np.testing.assert_array_equal(points.colors, [[128, 128, 128]])


def test_random_points_are_where_the_cameras_look(capture) -> None:
    load(capture)
    first, second = load_dataset(capture.root).points, load_dataset(capture.root).points
    assert torch.equal(first.positions, second.positions)
    assert len(first) == 20_000
    assert first.positions.norm(dim=1).max() < 2.1
    assert first.positions.mean(0).norm() < 0.05


def test_foreign_formats_are_not_claimed_by_the_reader(tmp_path) -> None:
    assert load_transforms(tmp_path) is None


def test_missing_photographs_are_named(capture) -> None:
    capture.write_images()
    capture.write_transforms({**LENS, "frames": capture.frames()})
    for name in capture.names[:6]:
        (capture.root / "images" / name).unlink()
    with pytest.raises(InputError, match=r"6 of the 10 photographs .*0000.png, .* and 1 more; .*delete their entries"):
        load_dataset(capture.root)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fl_x": 0, "fl_y": 0}, "fl_x of the lens of 0000.png is 0; expected a finite number above 0"),
        ({"fl_x": 0}, "fl_x of the lens of 0000.png is 0; expected a finite number above 0"),
        ({"fl_x": 1e-300}, "the lens of 0000.png: .* expected a finite number from 0.032"),
        ({"fl_x": 1e300}, "the lens of 0000.png: .* expected a finite number from 0.032"),
        ({"fl_x": 10**400}, "fl_x of the lens of 0000.png is inf; expected a finite number above 0"),
        ({"cx": 1e308}, r"the lens of 0000.png: .* instead of 1e\+308"),
        ({"k1": 1e30}, r"the lens of 0000.png: .* instead of 1e\+30"),
        ({"w": -200}, "w of the lens of 0000.png is -200; expected a finite number from 1 to 131072"),
        ({"h": 1e30}, r"h of the lens of 0000.png is 1e\+30; expected a finite number from 1 to 131072"),
        ({"is_fisheye": "false"}, "is_fisheye of the lens of 0000.png is 'false'; expected true or false"),
        ({"train_filenames": 5}, r"train_filenames of .*transforms\.json is 5; expected a list of values"),
        ({"train_filenames": [{}]}, r"entry 1 of train_filenames of .* is \{\}; expected a text"),
        ({"test_filenames": ["a", 5]}, "entry 2 of test_filenames of .* is 5; expected a text"),
        ({"distortion_params": [0.1, 0.2]}, "distortion_params of .*0000.png .*expected a list of 6 values"),
        ({"ply_file_path": 3}, r"ply_file_path of .*transforms\.json is 3; expected a text"),
        ({"frames": [3]}, r"frame 1 of .* is 3; expected an object with file_path, transform_matrix"),
        ({"frames": [{"file_path": "/", "transform_matrix": [[0] * 4] * 4}]}, "lacks 1 of the 1 photographs of "),
        ({"frames": [{"file_path": "a" * 999, "transform_matrix": [[0] * 4] * 4}]}, "lacks 1 of the 1 photographs of "),
        ({"fl_x": -5.0}, "fl_x of the lens of 0000.png is -5.0; expected a finite number above 0"),
        ({"w": float("inf")}, "w of the lens of 0000.png is inf; expected"),
        ({"fl_x": "wide"}, "fl_x of the lens of 0000.png is 'wide'; expected"),
        (
            {"camera_model": "EQUIRECTANGULAR"},
            "camera_model of .* is 'EQUIRECTANGULAR'; expected one of",
        ),
        ({"frames": []}, "lists no frames"),
        ({"frames": [{"transform_matrix": []}]}, "has no file_path"),
        ({"ply_file_path": "lost.ply"}, "ply_file_path names .*lost.ply, which does not exist"),
        ({"frames": [{"file_path": "images/0000.png", "transform_matrix": np.eye(4).tolist()}] * 2}, "has two frames"),
    ],
)
def test_settings_that_cannot_be_used(capture, change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load(capture, **change)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.full((4, 4), np.nan), "entry 1 of entry 1 of transform_matrix of frame 1 of .* is nan; expected a finite"),
        ([*np.eye(4).tolist()[:3], [0, 0, 10**400, 1]], "entry 3 of entry 4 of .* is inf; expected"),
        (np.eye(4) * 1e300, r"entry 1 of entry 1 of transform_matrix .* is 1e\+300; expected a finite number from"),
        (np.diag([2.0, 2, 2, 1]), "is not rigid"),
        (np.diag([1.0, 1, -1, 1]), "determinant -1"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
        (np.eye(2), r"entry 1 of transform_matrix .* is \[1.0, 0.0\]; expected a list of 4 values"),
        (["a"], "entry 1 of transform_matrix .* is 'a'; expected a list of 4 values"),
        (np.eye(4).tolist()[:2], r"shape \[2, 4\]"),
        (None, "transform_matrix of frame 1 of .* is None; expected a list"),
    ],
)
def test_poses_that_cannot_be_used(capture, matrix: Any, message: str) -> None:
    frames = capture.frames()
    frames[0]["transform_matrix"] = matrix.tolist() if isinstance(matrix, np.ndarray) else matrix
    with pytest.raises(InputError, match=message):
        load(capture, frames=frames)


def test_pose_of_three_rows_and_rounded_rotation(capture) -> None:
    frames = capture.frames()
    for frame in frames:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 3).tolist()[:3]
    found = load(capture, frames=frames)
    for shot, pose in zip(found.shots, capture.poses, strict=True):
        rotation = shot.cam_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(shot.cam_from_world, pose, atol=5e-3)


@pytest.mark.parametrize("content", ["{", "[1, 2]", '{"frames": 3}'])
def test_a_file_that_is_not_transforms_json_is_refused(capture, content: str) -> None:
    capture.root.mkdir()
    (capture.root / "transforms.json").write_text(content)
    with pytest.raises(InputError, match=r"transforms\.json"):
        load_dataset(capture.root)


def test_points_of_the_model_next_to_frames_of_nerfstudio_are_mentioned(capture) -> None:
    load(capture)
    folder = capture.root / "colmap"
    (warning,) = load_dataset(capture.root).warnings
    assert warning.endswith("random points are used instead.")
    (folder / "sparse" / "0").mkdir(parents=True)
    capture.reconstruction().write_binary(folder / "sparse" / "0")
    (warning,) = load_dataset(capture.root).warnings
    assert f"Those of {folder / 'sparse' / '0' / 'points3D.bin'} are not read" in warning and "ply_file_path" in warning
    (folder / "images").symlink_to(capture.root / "images")
    assert len(load_dataset(folder).points) == len(capture.points), "the folder can be read as it is said"


@pytest.mark.parametrize(
    ("axes", "message"), [(None, r"points3d\.ply is not a PLY file"), ("xz", "has no vertex property y; expected a p")]
)
def test_a_ply_that_is_not_a_point_cloud_is_refused(axes: str | None, message: str, capture) -> None:
    capture.root.mkdir()
    header = ["ply", "format ascii 1.0", "element vertex 1", *(f"property float {n}" for n in axes or "")]
    content = "not a ply\n" if axes is None else "\n".join([*header, "end_header", "0 1", ""])
    (capture.root / "points3d.ply").write_text(content)
    with pytest.raises(InputError, match=message):
        load(capture)


def test_distorted_photograph_is_undistorted(capture) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    found = load(capture, k1=0.1)
    lens = found.shots[0].lens.as_colmap()
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    view = load_dataset(capture.root).train[0]
    assert (view.camera.width, view.camera.height) == (pinhole.width, pinhole.height)
    assert tuple(view.photo.shape) == (pinhole.height, pinhole.width, 3)


@pytest.mark.parametrize("binary", [True, False])
def test_points_that_are_a_link_to_nowhere_are_not_replaced_by_random_ones(capture, binary: bool) -> None:
    capture.write_images()
    capture.write_transforms({**LENS, "frames": capture.frames()})
    (capture.root / "points3d.ply").symlink_to("/nowhere")
    with pytest.raises(InputError, match=r"points3d\.ply is not a readable file"):
        load_dataset(capture.root)
    points = capture.write_colmap(binary=binary) / f"points3D.{'bin' if binary else 'txt'}"
    points.unlink()
    points.symlink_to("/nowhere")
    with pytest.raises(InputError, match=r"points3D\.\w+ does not exist"):
        load_dataset(capture.root)
    points.unlink()
    points.mkdir()
    with pytest.raises(InputError, match=r"points3D\.\w+ cannot be read \(it is a folder"):
        load_dataset(capture.root)


@pytest.mark.parametrize("spelled", ["whole", "relative", "by a link"])
def test_names_do_not_depend_on_how_the_capture_is_spelled(
    spelled: str, capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture.names = [f"{side}/{name}" for side, name in zip(("left", "right") * 5, capture.names, strict=True)]
    capture.write_images()
    capture.write_transforms({**LENS, "frames": capture.frames(f"{capture.root}/images/")})
    monkeypatch.chdir(capture.root.parent)
    (capture.root.parent / "link").symlink_to(capture.root)
    root = {"whole": capture.root, "relative": Path(capture.root.name), "by a link": Path("link")}[spelled]
    found = load_transforms(root)
    assert found is not None and [shot.name for shot in found.shots] == capture.names


def test_photographs_elsewhere_with_one_name_in_two_folders_have_their_folders_names(capture) -> None:
    capture.names = [f"{side}/{number}.png" for number in range(5) for side in ("left", "right")]
    capture.write_images(folder="../photographs")
    capture.write_transforms({**LENS, "frames": capture.frames("../photographs/")})
    found = load_transforms(capture.root)
    assert found is not None and sorted(shot.name for shot in found.shots) == sorted(capture.names)


@pytest.mark.parametrize("shares", [{"fl_x": 0.9, "fl_y": 1.3, "cx": 0.47, "cy": 0.54}, {"cx": 0.5, "cy": 0.5}])
def test_intrinsics_given_as_shares_of_the_image_are_refused(capture, shares: dict[str, float]) -> None:
    with pytest.raises(InputError, match="look like shares of its sides: multiply fl_x and cx by the width"):
        load(capture, **shares)


def test_an_opening_angle_of_a_frame_goes_before_the_length_of_the_file(capture) -> None:
    angled = [{**frame, "camera_angle_x": 2 * math.atan(16 / 40.0)} for frame in capture.frames()[:1]]
    found = load(capture, frames=[*angled, *capture.frames()[1:]])
    lengths = [shot.lens.focal_lengths() for shot in found.shots]
    assert lengths[0] == pytest.approx((40.0, 40.0)) and lengths[1] == (30.0, 31.0)


def test_the_validation_split_replaces_a_missing_test_split(capture) -> None:
    capture.write_images()
    capture.write_transforms({**LENS, "frames": capture.frames()[:-1]}, file_name="transforms_train.json")
    capture.write_transforms({**LENS, "frames": capture.frames()[-1:]}, file_name="transforms_val.json")
    found = load_transforms(capture.root)
    assert found is not None and found.test_shots is not None
    assert [shot.name for shot in found.test_shots] == capture.names[-1:]
    assert any("the test views are those of transforms_val.json" in warning for warning in found.warnings)


def test_photographs_of_the_validation_part_are_not_trained_on(capture) -> None:
    capture.write_images()
    capture.write_transforms({**LENS, "frames": capture.frames()}, file_name="transforms_train.json")
    capture.write_transforms({**LENS, "frames": capture.frames()[-2:]}, file_name="transforms_val.json")
    data = load_dataset(capture.root)
    assert [view.name for view in data.test] == capture.names[-2:]
    assert [view.name for view in data.train] == capture.names[:-2]


def test_a_validation_split_without_photographs_is_ignored(capture) -> None:
    capture.write_images()
    gone = [{**frame, "file_path": f"gone/{index}.png"} for index, frame in enumerate(capture.frames())]
    capture.write_transforms({**LENS, "frames": capture.frames()}, file_name="transforms_train.json")
    capture.write_transforms({**LENS, "frames": gone}, file_name="transforms_val.json")
    found = load_transforms(capture.root)
    assert found is not None and found.test_shots is None and len(found.shots) == len(capture.names)
