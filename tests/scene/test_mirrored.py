from __future__ import annotations

import torch

from glassplat.scene.camera import mirror_matrices, rotation_from_quat
from glassplat.scene.gaussians import mirrored_gaussians
from tests.render.tiny_scene import random_gaussians

CENTER = torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64)
NORMAL = torch.nn.functional.normalize(torch.tensor([0.4, 0.1, -1.0], dtype=torch.float64), dim=0)


def covariances(gaussians) -> torch.Tensor:  # type: ignore[no-untyped-def]
    axes = rotation_from_quat(gaussians.quats) * gaussians.log_scales.exp()[:, None, :]
    return axes @ axes.mT


def test_means_and_covariances_are_mirrored() -> None:
    before = random_gaussians(20, (0.0, 0.0, 3.0), seed=4)
    after = mirrored_gaussians(before, CENTER, NORMAL)
    matrix = mirror_matrices(CENTER[None], NORMAL[None])[0]
    torch.testing.assert_close(after.means, before.means @ matrix[:3, :3].T + matrix[:3, 3])
    torch.testing.assert_close(covariances(after), matrix[:3, :3] @ covariances(before) @ matrix[:3, :3].T)
    assert torch.equal(after.sh[:, 0], before.sh[:, 0]) and not bool(after.sh[:, 1:].any())
    assert bool(before.sh[:, 1:].all()), "the Gaussians that are mirrored stay as they are"


def test_mirroring_twice_gives_the_gaussians_back() -> None:
    before = random_gaussians(20, (0.0, 0.0, 3.0), seed=4)
    after = mirrored_gaussians(mirrored_gaussians(before, CENTER, NORMAL), CENTER, -NORMAL)
    torch.testing.assert_close(after.means, before.means)
    torch.testing.assert_close(covariances(after), covariances(before))
