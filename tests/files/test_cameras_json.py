import json
from pathlib import Path

import torch

from glassplat.files.cameras_json import write_cameras
from glassplat.scene.camera import Camera
from glassplat.scene.pose import rotation_from_quat


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
