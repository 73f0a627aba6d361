"""Rotations as quaternions and as matrices, and the intrinsics of cameras."""

from __future__ import annotations

import hypothesis
import hypothesis.strategies as st
import torch

from glassplat.scene.camera import quat_from_rotation, rotation_from_quat
from tests.render.tiny_scene import camera_at


@hypothesis.given(st.integers(0, 2**32 - 1), st.lists(st.booleans(), min_size=4, max_size=4).filter(any))
def test_a_rotation_comes_back_from_its_quaternion(seed: int, nonzero: list[bool]) -> None:
    quat = torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * torch.tensor(nonzero)
    rotation = rotation_from_quat(quat)
    found = quat_from_rotation(rotation)
    torch.testing.assert_close(found.norm(), torch.ones((), dtype=torch.float64))
    torch.testing.assert_close(rotation_from_quat(found), rotation)


def test_returned_intrinsics_are_copies() -> None:
    camera = camera_at(0.0, 0.0, 0.0)
    before = camera.intrinsics.tolist()
    camera.intrinsics[0] = 1.0
    assert camera.intrinsics.tolist() == camera_at(1.0, 0.0, 0.0).intrinsics.tolist() == before
