"""Random Gaussians in front of random cameras, one of them mirrored, for the tests of the kernels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from glassplat.kernels.records import CameraBatch, Projected, RawGaussians, Splats

WIDTH, HEIGHT = 44, 36


def draw(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_gaussians(count: int, *, coefficients: int = 16, dtype: torch.dtype = torch.float64) -> RawGaussians:
    """Gaussians around (0, 0, 4), some of them behind the cameras, off screen or too faint to be visible."""
    tensors = (
        torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64) + 1.5 * draw(count, 3, seed=1),
        draw(count, 4, seed=2),
        -2 + 0.7 * draw(count, 3, seed=3),
        2 * draw(count, seed=4),
        0.6 * draw(count, coefficients, 3, seed=5),
    )
    return RawGaussians(*(tensor.to(dtype).requires_grad_() for tensor in tensors))


def random_cameras(count: int, *, clip: bool = False, dtype: torch.dtype = torch.float64) -> CameraBatch:
    """Cameras near the origin that look along +z; every second one is mirrored, and rotations are not quite rigid."""
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, :3] += 0.1 * draw(count, 3, 4, seed=6)
    poses[1::2, :3, 0] *= -1
    intrinsics = torch.tensor([40.0, 43.0, 23.0, 17.0], dtype=torch.float64) + draw(count, 4, seed=7)
    planes = torch.tensor([0.1, -0.2, 1.0, -3.0], dtype=torch.float64) + 0.1 * draw(count, 4, seed=8)
    return CameraBatch(
        poses.to(dtype).requires_grad_(), intrinsics.to(dtype), WIDTH, HEIGHT, planes.to(dtype) if clip else None
    )


def needle_before_camera(angle: float, dtype: torch.dtype) -> tuple[RawGaussians, CameraBatch]:
    """One thin, oblique Gaussian without colours, whose standard deviation on screen is 300 px; and its camera."""
    focal, size = 100.0, 96
    tensors = (
        torch.tensor([[0.013, -0.021, 1.0]], dtype=torch.float64),
        torch.tensor([[math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]], dtype=torch.float64),
        torch.tensor([[300 / focal, 1e-4, 1e-4]], dtype=torch.float64).log(),
        torch.tensor([2.0], dtype=torch.float64),
        torch.zeros(1, 0, 3, dtype=torch.float64),
    )
    needle = RawGaussians(*(tensor.to(dtype).requires_grad_() for tensor in tensors))
    intrinsics = torch.tensor([[focal, focal, size / 2, size / 2]], dtype=dtype)
    return needle, CameraBatch(torch.eye(4, dtype=dtype)[None].requires_grad_(), intrinsics, size, size)


HUGE = 0.4  # of the largest number that the type can represent
POISON = {
    "means": [math.nan, math.inf, -math.inf, HUGE],
    "quats": [math.nan, math.inf, HUGE],
    "log_scales": [math.nan, math.inf, -math.inf, HUGE],
    "logit_opacities": [math.nan, math.inf, -HUGE, -math.inf],
    "sh": [math.nan, math.inf, -math.inf],
}


def poisoned(clean: RawGaussians, seen: Tensor) -> tuple[RawGaussians, list[int]]:
    """The Gaussians with each of these values placed in a different one of those seen, and the indices of these."""
    tensors, victims = [tensor.detach().clone() for tensor in clean], []
    for name, values in POISON.items():
        for value in values:
            victim = int(seen[len(victims)])
            value = value * torch.finfo(clean.means.dtype).max if abs(value) == HUGE else value
            tensors[RawGaussians._fields.index(name)].view(len(clean.means), -1)[victim, 0] = value
            victims.append(victim)
    return RawGaussians(*(tensor.requires_grad_() for tensor in tensors)), victims


def as_splats(projected: Projected) -> Splats:
    """The inputs of rasterisation, detached from the graph."""
    fields = (projected.means2d, projected.conics, projected.opacities, projected.depths, projected.radii)
    return Splats(*(field.detach() for field in fields))
