import json
from pathlib import Path

import numpy as np
import pytest
import torch

from glassplat.files.sidecars import read_cameras, write_cameras, write_colmap
from glassplat.scene.camera import Camera, rotation_from_quat


def test_entries_give_the_pose_of_the_camera_in_the_world(tmp_path: Path) -> None:
    pose = torch.eye(4)
    pose[:3, :3] = rotation_from_quat(torch.tensor([0.9, 0.1, -0.3, 0.2]))
    pose[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    camera = Camera(pose, fx=10.0, fy=11.0, cx=4.0, cy=3.0, width=8, height=6)
    write_cameras(tmp_path / "cameras.json", [("a.jpg", camera), ("b.jpg", camera)])
    first, second = json.loads((tmp_path / "cameras.json").read_text())
    assert (first["id"], first["img_name"], second["id"], second["img_name"]) == (0, "a.jpg", 1, "b.jpg")
    assert [first[key] for key in ("width", "height", "fx", "fy", "cx", "cy")] == [8, 6, 10.0, 11.0, 4.0, 3.0]
    world_from_cam = torch.eye(4)
    world_from_cam[:3, :3] = torch.tensor(first["rotation"])
    world_from_cam[:3, 3] = torch.tensor(first["position"])
    torch.testing.assert_close(world_from_cam @ pose, torch.eye(4), atol=1e-6, rtol=0)


def test_cameras_round_trip(tmp_path: Path) -> None:
    pose = torch.eye(4)
    pose[:3, :3] = rotation_from_quat(torch.tensor([0.9, 0.1, -0.3, 0.2]))
    pose[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    camera = Camera(pose, fx=10.0, fy=11.0, cx=4.5, cy=3.0, width=8, height=6)
    write_cameras(tmp_path / "cameras.json", [("a.jpg", camera), ("b.jpg", camera)])
    (name, first), (other, _) = read_cameras(tmp_path / "cameras.json")
    assert (name, other) == ("a.jpg", "b.jpg")
    torch.testing.assert_close(first.cam_from_world, pose, atol=1e-6, rtol=0)
    names = ("fx", "fy", "cx", "cy", "width", "height")  # Since Python 3.13, cameras cannot be compared as a whole.
    assert [getattr(first, name) for name in names] == [getattr(camera, name) for name in names]


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_a_colmap_model_has_positions_in_any_unit(unit: float, tmp_path: Path) -> None:
    pose = torch.eye(4)
    pose[:3, 3] = unit * torch.tensor([1.23456789, -2.3456789, 0.3456789])
    camera = Camera(pose, fx=10.0, fy=11.0, cx=4.5, cy=3.0, width=8, height=6)
    write_colmap(tmp_path, [("a.jpg", camera)], np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))
    (line,) = (tmp_path / "images.txt").read_text().split("\n\n")[:-1]
    stored = [float(value) for value in line.split()[5:8]]
    assert stored == pytest.approx(pose[:3, 3].tolist(), rel=1e-7)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "rotation of camera 1"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [1, 0, 0]]}, "rotation of camera 1"),
        ({"position": [0, 0]}, "position of camera 1"),
        ({"fx": 0}, "fx of camera 1"),
        ({"width": 2**40}, "width of camera 1"),
        ({"img_name": None}, "img_name of camera 1"),
    ],
)
def test_invalid_cameras_are_refused(change: dict, words: str, tmp_path: Path) -> None:
    whole = {"img_name": "a", "width": 8, "height": 6, "position": [0, 0, 0], "fx": 8, "fy": 8}
    whole["rotation"] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([whole]))
    assert read_cameras(path)[0][1].cx == 4
    path.write_text(json.dumps([whole | change]))
    with pytest.raises(ValueError, match=words):
        read_cameras(path)
    path.write_text("{}")
    with pytest.raises(ValueError, match="expected a list"):
        read_cameras(path)
