"""Estimated normals of photographs: their file names, their axes, and files that are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from glassplat.captures.dataset import load_dataset
from glassplat.captures.view import View, estimated_normals, normals_paths, normals_reader
from glassplat.errors import InputError
from glassplat.scene.camera import Camera

SIZE = 12


def view_in(folder: Path, pose: torch.Tensor | None = None) -> View:
    camera = Camera(torch.eye(4) if pose is None else pose, 10.0, 10.0, 6.0, 6.0, SIZE, SIZE)
    (folder / "images").mkdir(exist_ok=True)
    path = folder / "images" / "a.jpg"
    Image.fromarray(np.zeros((SIZE, SIZE, 3), dtype=np.uint8)).save(path)
    found = normals_paths({"a.jpg": path}).get("a.jpg")
    photo = torch.zeros(SIZE, SIZE, 3, dtype=torch.uint8)
    return View("a.jpg", camera, path, lambda: photo, read_normals=normals_reader(found, camera))


def write(folder: Path, name: str, vectors: np.ndarray) -> None:
    (folder / "normals").mkdir(exist_ok=True)
    path = folder / "normals" / name
    if path.suffix == ".npy":
        np.save(path, vectors)
    else:
        Image.fromarray(np.round(255 * (vectors + 1) / 2).astype(np.uint8)).save(path)


def all_along(vector: tuple[float, float, float], size: int = SIZE) -> np.ndarray:
    return np.tile(np.array(vector, dtype=np.float32), (size, size, 1))


@pytest.mark.parametrize("name", ["a.png", "a.npy", "a.jpg.npy"])
def test_normals_towards_the_camera_point_backwards(tmp_path: Path, name: str) -> None:
    write(tmp_path, name, all_along((0.0, 0.0, 1.0)))
    found = estimated_normals(view_in(tmp_path))
    assert found is not None
    torch.testing.assert_close(found, torch.tensor([0.0, 0.0, -1.0]).expand(SIZE, SIZE, 3), atol=0.01, rtol=0)


def test_they_turn_with_the_camera(tmp_path: Path) -> None:
    write(tmp_path, "a.npy", all_along((0.0, 1.0, 0.0)))
    pose = torch.eye(4)
    # The camera's right is the world's up: +x of the camera is +z of the world.
    pose[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    found = estimated_normals(view_in(tmp_path, pose))
    assert found is not None
    torch.testing.assert_close(found[0, 0], -pose[1, :3])


def test_larger_maps_are_averaged_and_holes_stay_holes(tmp_path: Path) -> None:
    vectors = all_along((0.0, 0.0, 1.0), 3 * SIZE)
    vectors[: 3 * SIZE // 2] = np.nan
    write(tmp_path, "a.npy", vectors)
    found = estimated_normals(view_in(tmp_path))
    assert found is not None
    assert int(found[: SIZE // 2].count_nonzero()) == 0 and bool((found[SIZE // 2 :, :, 2] == -1).all())


def test_photographs_without_a_file_have_no_normals(tmp_path: Path) -> None:
    assert estimated_normals(view_in(tmp_path)) is None


def test_invalid_normal_maps_are_refused(tmp_path: Path) -> None:
    for vectors, message in [
        (
            np.zeros((SIZE, 2 * SIZE, 3), dtype=np.float32),
            "24x12 pixels, its photograph 12x12 here, without",
        ),
        (np.zeros((SIZE, SIZE), dtype=np.float32), r"holds float32 of shape \[12, 12\]; expected floats \[H, W, 3\]"),
        (np.zeros((SIZE, SIZE, 3), dtype=np.int64), "holds int64 of shape"),
    ]:
        write(tmp_path, "a.npy", vectors)
        with pytest.raises(InputError, match=message):
            estimated_normals(view_in(tmp_path))
    (tmp_path / "normals" / "a.npy").unlink()
    Image.new("L", (SIZE, SIZE)).save(tmp_path / "normals" / "a.png")
    with pytest.raises(InputError, match=r"a\.png is grey; expected normals as colours"):
        estimated_normals(view_in(tmp_path))
    (tmp_path / "normals" / "a.png").unlink()
    # The second was found by damaging files at random: NumPy evaluates the header as Python source.
    head = b"\x93NUMPY\x01\x00v\x00\xd8'descr': '<f4', 'fortran_order': False, 'shape': (2, 3, 3), }" + b" " * 60
    for damaged in (b"no", head):
        (tmp_path / "normals" / "a.npy").write_bytes(damaged)
        with pytest.raises(InputError, match="is not an array that NumPy can read"):
            estimated_normals(view_in(tmp_path))


def test_an_archive_by_the_name_of_an_array_is_refused(tmp_path: Path) -> None:
    (tmp_path / "normals").mkdir()
    with (tmp_path / "normals" / "a.npy").open("wb") as file:
        np.savez(file, normals=all_along((0.0, 0.0, 1.0)))
    with pytest.raises(InputError, match=r"a\.npy is not an array that NumPy can read .*; save it with numpy\.save"):
        estimated_normals(view_in(tmp_path))


def found_in(root: Path, files: list[str], photographs: dict[str, str]) -> dict[str, str]:
    """The existing files of normals by the name of the photograph; all paths from the root."""
    for file in files:
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).touch()
    found = normals_paths({name: root / path for name, path in photographs.items()})
    return {name: path.relative_to(root).as_posix() for name, path in found.items()}


FOLDERS = {name: f"images/{name}" for name in ("left/2.png", "right/2.png", "left/3.png")}


@pytest.mark.parametrize("folder", ["normals", "images/normals"])
def test_the_folder_of_a_photograph_is_a_part_of_its_name(tmp_path: Path, folder: str) -> None:
    files = [f"{folder}/left/2.png", f"{folder}/right/2.npy", f"{folder}/left/3.png.png"]
    assert found_in(tmp_path, files, FOLDERS) == dict(zip(FOLDERS, files, strict=True))


def test_a_duplicate_photograph_name_matches_neither(tmp_path: Path) -> None:
    found = found_in(tmp_path, ["images/normals/2.png", "images/normals/3.png"], FOLDERS)
    assert found == {"left/3.png": "images/normals/3.png"}


def test_normals_next_to_a_photograph_are_its_own(tmp_path: Path) -> None:
    files = ["images/left/normals/2.png", "images/right/normals/2.png"]
    assert found_in(tmp_path, files, FOLDERS) == {"left/2.png": files[0], "right/2.png": files[1]}
    flat = {"2.png": "images/2.png", "left/2.png": "images/left/2.png"}
    assert found_in(tmp_path / "flat", ["images/normals/2.png"], flat) == {"2.png": "images/normals/2.png"}


def test_names_that_lead_elsewhere_count_without_their_folders(tmp_path: Path) -> None:
    for folder in ("images", "images/normals", "elsewhere/normals"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    photograph, normals = tmp_path / "elsewhere" / "a.png", tmp_path / "elsewhere" / "normals" / "a.png"
    photograph.touch()
    for name in ("../elsewhere/a.png", str(photograph)):
        assert normals_paths({name: tmp_path / "images" / name}) == {}
    normals.touch()
    for name in ("../elsewhere/a.png", str(photograph)):
        (found,) = normals_paths({name: tmp_path / "images" / name}).values()
        assert found.samefile(normals)


def test_photographs_may_be_named_from_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "normals" / "left").mkdir(parents=True)
    (tmp_path / "normals" / "left" / "a.png").touch()
    assert normals_paths({"left/a.png": Path("left/a.png")}) == {"left/a.png": Path("normals/left/a.png")}


def test_views_of_a_capture_have_the_normals_of_their_folder(capture) -> None:
    capture.names[1:3] = ["left/2.png", "right/2.png"]
    capture.write_colmap()
    (capture.root / "normals" / "left").mkdir(parents=True)
    np.save(capture.root / "normals" / "left" / "2.npy", np.ones((24, 32, 3), dtype=np.float32))
    data = load_dataset(capture.root)
    assert [view.name for view in (*data.train, *data.test) if view.normals is not None] == ["left/2.png"]
