"""A mirrored camera's image is the camera's image of mirrored Gaussians (TR-Gaussians, Eqs. 8 to 12 written out)."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from glassplat.kernels.project import project
from glassplat.kernels.project.reference import sh_basis
from glassplat.kernels.records import CameraBatch, RawGaussians
from tests.kernels.gaussians_and_cameras import draw, random_cameras, random_gaussians

NEAR = 0.1


def rigid_camera(seed: int) -> CameraBatch:
    """A right-handed camera at a random position that looks roughly towards +z."""
    rotation, _ = torch.linalg.qr(torch.eye(3, dtype=torch.float64) + 0.3 * draw(3, 3, seed=seed))
    rotation = rotation * rotation.diagonal().sign()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, 0.5 * draw(3, seed=seed + 1)
    assert torch.linalg.det(rotation) > 0
    return random_cameras(1)._replace(cam_from_world=pose[None])


def mirror_matrix(point: Tensor, normal: Tensor) -> Tensor:
    """The Householder reflection M about the plane through `point`."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] -= 2 * torch.outer(normal, normal)
    matrix[:3, 3] = 2 * (point @ normal) * normal
    return matrix


def rotation_of(quat: Tensor) -> Tensor:
    """R of a quaternion wxyz, by its definition q v q*."""
    w, x, y, z = quat / quat.norm()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + 2 * w * skew + 2 * skew @ skew


def quat_of(rotation: Tensor) -> Tensor:
    """A quaternion wxyz of R, through the eigenvector of the symmetric 4x4 matrix that it maximises."""
    m = rotation
    k = torch.stack([
        torch.stack([m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]),
        torch.stack([m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]]),
        torch.stack([m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]]),
        torch.stack([m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]]),
    ])  # fmt: skip
    return torch.linalg.eigh(k).eigenvectors[:, -1]


def mirrored(vectors: Tensor, normal: Tensor) -> Tensor:
    """v - 2 (v . n / |n|) n, as in Eqs. 10 and 11."""
    return vectors - 2 * (vectors @ normal / normal.norm())[:, None] * normal


def mirrored_gaussians(gaussians: RawGaussians, point: Tensor, normal: Tensor) -> RawGaussians:
    """Eqs. 8 to 10; colours are left to Eq. 11."""
    means = gaussians.means - 2 * ((gaussians.means - point) @ normal / normal.norm())[:, None] * normal
    quats = []
    for quat in gaussians.quats:
        axes = mirrored(rotation_of(quat).T, normal)
        axes[0] = -axes[0]
        quats.append(quat_of(axes.T))
    return gaussians._replace(means=means, quats=torch.stack(quats))


@pytest.mark.parametrize("seed", [10, 20, 30])
def test_mirroring_the_camera_is_mirroring_the_gaussians(seed: int) -> None:
    gaussians = RawGaussians(*(tensor.detach() for tensor in random_gaussians(120)))
    camera = rigid_camera(seed)
    normal = torch.nn.functional.normalize(draw(3, seed=seed + 2), dim=0)
    point = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64) + 0.3 * draw(3, seed=seed + 3)
    matrix = mirror_matrix(point, normal)
    # The Gaussians are mirrored once more beforehand, so that their mirror images lie in front of the camera.
    behind = mirrored_gaussians(gaussians, point, normal)

    ours = project(behind, camera._replace(cam_from_world=camera.cam_from_world @ matrix), sh_degree=3, near=NEAR)
    images = mirrored_gaussians(behind, point, normal)
    theirs = project(images, camera, sh_degree=3, near=NEAR)

    assert (ours.radii[..., 0] > 0).sum() > 15
    for name in ("means2d", "conics", "depths", "opacities", "radii"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=1e-9, atol=1e-9)

    # Eq. 11: the colour of a mirror image, seen along d, is the Gaussian's own colour along the reflected direction.
    pose = camera.cam_from_world[0]
    center = -pose[:3, :3].T @ pose[:3, 3]
    directions = torch.nn.functional.normalize(images.means - center, dim=-1)
    basis = sh_basis(mirrored(directions, normal))
    colors = (0.5 + torch.einsum("nk,nkc->nc", basis, gaussians.sh)).clamp(min=0)
    visible = theirs.radii[0, :, 0] > 0
    torch.testing.assert_close(ours.colors[0, visible], colors[visible], rtol=1e-9, atol=1e-9)


def test_the_mirrored_camera_is_left_handed() -> None:
    matrix = mirror_matrix(torch.zeros(3, dtype=torch.float64), torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64))
    pose = rigid_camera(40).cam_from_world[0] @ matrix
    assert torch.linalg.det(pose[:3, :3]).item() == pytest.approx(-1)
