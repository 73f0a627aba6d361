"""COLMAP captures, written by COLMAP's own code and read by glassplat."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Literal
from unicodedata import normalize

import numpy as np
import pytest
import torch
from PIL import Image

from glassplat.captures.capture import Capture
from glassplat.captures.colmap import load_colmap, read_model
from glassplat.captures.dataset import load_dataset
from glassplat.errors import InputError


def load(root: Path) -> Capture:
    found = load_colmap(root)
    assert found is not None
    return found


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "."])
def test_reads_what_colmap_wrote(capture, binary: bool, folder: str) -> None:
    capture.write_colmap(binary=binary, folder=folder)
    found = load(capture.root)
    assert [shot.name for shot in found.shots] == capture.names
    for shot, pose in zip(found.shots, capture.poses, strict=True):
        np.testing.assert_allclose(shot.cam_from_world, pose, atol=1e-9)
        assert list(shot.lens.parameters) == capture.lenses[0][1]
    assert found.points is not None
    order = np.lexsort(capture.points.T)
    read_order = np.lexsort(found.points.positions.astype(float).T)
    np.testing.assert_allclose(found.points.positions[read_order], capture.points[order], atol=1e-6)
    np.testing.assert_array_equal(found.points.colors[read_order], capture.colors[order])


def test_observations_and_tracks_are_skipped(capture) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = capture.reconstruction()
    for image_id in (1, 2):
        model.images[image_id].points2D = [pycolmap.Point2D([1.0, 2.0]), pycolmap.Point2D([3.0, 4.0])]
    for index, point_id in enumerate(list(model.points3D)[:2]):
        for image_id in (1, 2):
            model.add_observation(point_id, pycolmap.TrackElement(image_id, index))
    for write in (model.write_binary, model.write_text):
        folder = capture.root / write.__name__
        folder.mkdir(parents=True)
        write(folder)
        read = read_model(folder)
        assert [image.name for image in read.images] == capture.names
        assert len(read.points) == len(capture.points)


def test_several_cameras_and_nested_names(capture) -> None:
    capture.names = [f"side {index % 2}/{index:02d}.png" for index in range(10)]
    capture.lenses = [("PINHOLE", [30.0, 31.0, 16.0, 12.0]), ("SIMPLE_PINHOLE", [40.0, 15.5, 12.5])]
    capture.write_colmap(binary=False)
    data = load_dataset(capture.root)
    cameras = {view.name: view.camera for view in (*data.train, *data.test)}
    assert (cameras["side 0/00.png"].fx, cameras["side 0/00.png"].fy) == (30.0, 31.0)
    second = cameras["side 1/01.png"]
    assert (second.fx, second.fy, second.cx, second.cy) == (40.0, 40.0, 15.5, 12.5)


def test_a_binary_model_is_preferred_and_others_are_mentioned(capture) -> None:
    capture.write_colmap(binary=True)
    capture.write_colmap(binary=False, folder="sparse/1")
    found = load(capture.root)
    assert "(1)" in found.warnings[0]


def test_frames_next_to_a_model_are_mentioned(capture) -> None:
    capture.write_colmap()
    assert load_dataset(capture.root).warnings == ()
    capture.write_transforms({"frames": capture.frames()})
    (warning,) = load_dataset(capture.root).warnings
    assert "COLMAP model" in warning and "is read, and not transforms.json" in warning


def test_a_folder_without_a_model_is_not_claimed_by_the_reader(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    assert load_colmap(tmp_path) is None


@pytest.mark.parametrize(
    ("model", "extra"),
    [
        ("SIMPLE_RADIAL", [0.15]),
        ("RADIAL", [-0.12, 0.03]),
        ("OPENCV", [-0.2, 0.05, 0.004, -0.003]),
        ("FULL_OPENCV", [-0.2, 0.05, 0.001, 0.001, 0.0, 0.0, 0.0, 0.0]),
        ("OPENCV_FISHEYE", [0.02, 0.0, 0.0, 0.0]),
    ],
)
def test_distorted_photographs_and_masks_are_undistorted(capture, model: str, extra: list[float]) -> None:
    """A point that a distorted lens images at a pixel is found where the resulting pinhole camera projects it."""
    width, height = capture.size = (160, 120)
    focal = [130.0] if model in ("SIMPLE_RADIAL", "RADIAL") else [130.0, 128.0]
    capture.lenses = [(model, [*focal, 81.0, 58.0, *extra])]
    capture.write_colmap()
    lens = capture.reconstruction().cameras[1]
    corner = np.array([0.42, -0.3, 1.0])  # Off the axis, where distortion moves it by several pixels.
    x, y = lens.img_from_cam(corner[None])[0]
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    blob = ((np.hypot(columns - x, rows - y) < 4) * 255).astype(np.uint8)
    Image.fromarray(np.repeat(blob[:, :, None], 3, axis=2)).save(capture.root / "images" / "0001.png")
    capture.write_mask("panes/0001.png", blob // 255)

    view = next(v for v in load_dataset(capture.root).train if v.name == "0001.png")
    world = np.linalg.inv(capture.poses[1]) @ [*corner, 1.0]
    uv, _ = view.camera.project(torch.tensor(world[None, :3], dtype=torch.float32))
    assert view.pane_labels is not None
    assert view.photo.shape[:2] == view.pane_labels.shape == (view.camera.height, view.camera.width)
    for weights in (view.photo[:, :, 0].double(), view.pane_labels.double()):
        v, u = torch.meshgrid(*(torch.arange(n) + 0.5 for n in weights.shape), indexing="ij")
        found = torch.stack([(weights * u).sum(), (weights * v).sum()]) / weights.sum()
        torch.testing.assert_close(found, uv[0].double(), atol=0.35, rtol=0)
    assert set(view.pane_labels.unique().tolist()) == {0, 1}


def test_zero_distortion_is_a_pinhole(capture) -> None:
    capture.lenses = [("OPENCV", [30.0, 30.0, 16.0, 12.0, 0.0, 0.0, 0.0, 0.0])]
    capture.write_colmap()
    view = load_dataset(capture.root).train[0]
    assert (view.camera.width, view.camera.height, view.camera.fx) == (32, 24, 30.0)
    stored = np.array(Image.open(view.image_path))
    np.testing.assert_array_equal(view.photo.numpy(), stored)


def test_missing_photographs_are_counted_and_named(capture) -> None:
    capture.write_colmap()
    for name in capture.names[2:9]:
        (capture.root / "images" / name).unlink()
    with pytest.raises(InputError, match=r"7 of the 10 photographs .* 0002.png, .* 0006.png and 2 more"):
        load_dataset(capture.root)


@pytest.mark.parametrize("on_disk", ["NFC", "NFD"])
def test_unicode_normalisation_does_not_matter(capture, on_disk: Literal["NFC", "NFD"]) -> None:
    in_model: Literal["NFC", "NFD"] = "NFD" if on_disk == "NFC" else "NFC"
    capture.names = [normalize(in_model, f"f\u00fcr/\u00e9 {index}.png") for index in range(10)]
    capture.write_colmap()
    shutil.rmtree(capture.root / "images")
    capture.names = [normalize(on_disk, name) for name in capture.names]
    capture.write_images()
    capture.write_mask(f"panes/{capture.names[1]}", np.ones((24, 32), dtype=np.uint8))
    data = load_dataset(capture.root)
    assert sorted(view.name for view in (*data.train, *data.test)) == capture.names
    assert [view.name for view in data.train if view.is_annotated] == [capture.names[1]]


def test_missing_folder_of_images(capture) -> None:
    capture.write_colmap()
    (capture.root / "images").rename(capture.root / "pictures")
    with pytest.raises(InputError, match=r"no folder .*images"):
        load_dataset(capture.root)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.97])
def test_cut_off_binary_file_is_named(capture, name: str, share: float) -> None:
    path = capture.write_colmap() / f"{name}.bin"
    os.truncate(path, int(path.stat().st_size * share))
    with pytest.raises(InputError, match=rf"{name}\.bin is cut off or damaged \(it ends "):
        load_dataset(capture.root)


@pytest.mark.parametrize(
    ("name", "start", "data", "message"),
    [
        ("cameras", 12, b"\x63\0\0\0", r"a camera model of number 99; expected 0 to \d+"),
        ("images", 8 + 4 + 7 * 8 + 4, None, "it ends within a name"),
    ],
)
def test_damaged_binary_file_is_named(capture, name: str, start: int, data: bytes | None, message: str) -> None:
    path = capture.write_colmap() / f"{name}.bin"
    whole = path.read_bytes()
    path.write_bytes(whole[: start + 2] if data is None else whole[:start] + data + whole[start + len(data) :])
    with pytest.raises(InputError, match=rf"{name}\.bin is cut off or damaged \(it .*{message}|{message}"):
        load_dataset(capture.root)


@pytest.mark.parametrize(
    ("name", "line", "message"),
    [
        ("cameras", "1 BANANA 32 24 1 2 3", "unknown camera model 'BANANA'"),
        ("cameras", "1 EQUIRECTANGULAR 32 24 16 12", "EQUIRECTANGULAR .* cannot be undistorted"),
        ("cameras", "1 PINHOLE 32 24 30 30 16", "takes 4 parameters, got 3"),
        ("cameras", "1 PINHOLE 32 24 0 30 16 12", r"expected a finite number from 0.032 to 3.2e\+06 instead of 0"),
        ("cameras", "1 PINHOLE 32 24 nan 30 16 12", "finite"),
        ("cameras", "1 PINHOLE 0 24 30 30 16 12", "expected sides from 1 to 131072"),
        ("cameras", "1 PINHOLE -200 24 30 30 16 12", "the camera is -200x24 pixels"),
        ("cameras", f"1 PINHOLE {10**30} 24 30 30 16 12", "the camera is hugex24 pixels"),
        ("cameras", f"1 PINHOLE {10**308} 24 30 30 16 12", "the camera is hugex24 pixels"),
        ("cameras", f"1 PINHOLE {10**400} 24 30 30 16 12", "the camera is hugex24 pixels"),
        ("cameras", "1 PINHOLE 32 24 1e300 30 16 12", r"instead of 1e\+300"),
        ("cameras", "1 PINHOLE 32 24 1e-300 30 16 12", r"instead of 1e-300"),
        ("cameras", "1 PINHOLE 32 24 30 30 1e308 12", r"instead of 1e\+308"),
        ("cameras", "1 PINHOLE 32 24 30 30 16 12\n1 PINHOLE 32 24 40 40 16 12", "two cameras of one id"),
        ("cameras", "1 PINHOLE 32", r"cameras\.txt is cut off or damaged"),
        ("cameras", "2 PINHOLE 32 24 30 30 16 12", "camera is not in the COLMAP model"),
        ("images", "1 nan 0 0 0 1 2 3 1 0000.png\n", "rotation of 0000.png"),
        ("images", "1 2 0 0 0 1 2 3 1 0000.png\n", "expected a finite unit quaternion"),
        ("images", "1 1 0 0 0 inf 2 3 1 0000.png\n", "pose of 0000.png contains non-finite values"),
        ("images", "1 1e300 1e300 0 0 1 2 3 1 0000.png\n", "rotation of 0000.png"),
        ("images", "1 1 0 0 0 1e300 2 3 1 0000.png\n", r"the pose of 0000.png holds the value 1e\+300"),
        ("images", f"1 1 0 0 0 1 2 3 1 {'n' * 5000}.png\n", "lacks 1 of the 1 photographs of the COLMAP model"),
        ("images", "", r"images\.txt registers no photograph"),
        (
            "images",
            "1 1 0 0 0 1 2 3 1 0000.png\n2 1 0 0 0 1 2 3 1 0001.png",
            "line after 0000.png is not a list of obser",
        ),
        ("images", "1 1 0 0 0 1 2", r"images\.txt is cut off or damaged"),
        ("points3D", f"1 0 0 0 {10**400} 2 3 0", r"points3D\.txt is cut off or damaged"),
        ("points3D", "1 0 0 0 1 2 3 0\n2 0.5 0.5 0", r"points3D\.txt is cut off or damaged"),
        ("points3D", "1 0 0 0 256 2 3 0", "colour value 256; expected 0 to 255"),
        ("points3D", "1 0 0 0 1 2 -3 0", "colour value -3; expected 0 to 255"),
        ("points3D", "1 1e38 0 0 1 2 3 0", r"no point of the capture is finite and within 1e\+12"),
        ("cameras", "1 PINHOLE 32", r"damaged \(the line '1 PINHOLE 32'; expected at least 4 values"),
        ("images", "1 1 0 0 0 0 0 0 1", "expected at least 10 values"),
        ("points3D", "1 0 0 0 1 2", "expected at least 7 values"),
        ("points3D", "1 0.5 0.5 zero 1 2 3 0", r"points3D\.txt is cut off or damaged"),
    ],
)
def test_damaged_text_is_named(capture, name: str, line: str, message: str) -> None:
    (capture.write_colmap(binary=False) / f"{name}.txt").write_text(f"# comment\n{line}\n")
    with pytest.raises(InputError, match=message):
        load_dataset(capture.root)


@pytest.mark.parametrize("binary", [True, False])
def test_a_name_that_is_not_utf8_is_shown(capture, *, binary: bool) -> None:
    path = next(capture.write_colmap(binary=binary).glob("images.*"))
    path.write_bytes(path.read_bytes().replace(b"0002.png", b"caf\xe9.png"))
    with pytest.raises(
        InputError, match=r"images\.(bin|txt) holds the name b'caf\\xe9\.png', which is not valid UTF-8;"
    ):
        load_dataset(capture.root)


def test_points_that_are_not_finite_are_left_out(capture) -> None:
    path = capture.write_colmap(binary=False) / "points3D.txt"
    path.write_text(path.read_text() + "99 nan 0 0 1 2 3 0\n")
    data = load_dataset(capture.root)
    assert len(data.points) == len(capture.points)
    assert any("1 points are ignored: non-finite, or beyond 1e+12" in warning for warning in data.warnings)


@pytest.mark.parametrize("binary", [True, False])
def test_points_may_be_stored_in_the_other_way(capture, *, binary: bool) -> None:
    folder = capture.write_colmap(binary=not binary)
    (points,) = folder.glob("points3D.*")
    kept = points.read_bytes()
    points.unlink()
    capture.write_colmap(binary=binary)
    (points.with_suffix(".bin" if binary else ".txt")).unlink()
    points.write_bytes(kept)
    if not binary:
        for name in ("cameras.bin", "images.bin"):
            (folder / name).unlink()
    assert len(load_dataset(capture.root).points) == len(capture.points)


def test_model_without_points_gets_random_ones(capture) -> None:
    (capture.write_colmap() / "points3D.bin").unlink()
    data = load_dataset(capture.root)
    assert len(data.points) > 1000
    assert any("no points" in warning for warning in data.warnings)


def test_photographs_reduced_after_calibration_rescale_the_camera(capture) -> None:
    capture.write_colmap()
    capture.size = (16, 12)
    capture.write_images()
    data = load_dataset(capture.root)
    assert (data.train[0].camera.width, data.train[0].camera.fx, data.train[0].camera.cx) == (16, 15.0, 8.0)
    assert any("scaled copies" in warning for warning in data.warnings)


@pytest.mark.parametrize("size", [(1, 1), (7, 7), (9, 8)])
def test_photographs_of_a_few_pixels_are_no_scaled_copies(capture, size: tuple[int, int]) -> None:
    capture.write_colmap()
    capture.size = size
    capture.write_images()
    with pytest.raises(InputError, match=rf"0000.png is {size[0]}x{size[1]} pixels"):
        load_dataset(capture.root)


def test_a_text_model_may_come_from_another_system(capture) -> None:
    folder = capture.write_colmap(binary=False)
    before = load_dataset(capture.root)
    for path in folder.glob("*.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    after = load_dataset(capture.root)
    assert [view.name for view in after.train] == [view.name for view in before.train]
    assert torch.equal(after.points.positions, before.points.positions)


def test_a_model_without_photographs_next_to_its_masks_is_named(capture) -> None:
    folder = capture.write_colmap()
    capture.write_mask("panes/0001.png", np.ones((24, 32), dtype=np.uint8))
    (folder / "images.bin").write_bytes(bytes(8))
    with pytest.raises(InputError, match=r"images\.bin registers no photograph"):
        load_dataset(capture.root)


def test_photographs_of_another_aspect_are_refused(capture) -> None:
    capture.write_colmap()
    capture.size = (24, 32)
    capture.write_images()
    with pytest.raises(InputError, match=r"0000.png is 24x32 pixels, but its camera 32x24"):
        load_dataset(capture.root)


def test_a_photograph_that_is_not_an_image_is_named(capture) -> None:
    capture.write_colmap()
    (capture.root / "images" / "0003.png").write_bytes(b"not an image")
    with pytest.raises(InputError, match=r"0003\.png as an image"):
        load_dataset(capture.root)


def test_photograph_cut_off_is_named_when_it_is_read(capture) -> None:
    capture.write_colmap()
    path = capture.root / "images" / "0003.png"
    os.truncate(path, path.stat().st_size // 2)
    view = next(v for v in load_dataset(capture.root).train if v.name == "0003.png")
    with pytest.raises(InputError, match=r"0003\.png as an image"):
        _ = view.photo
