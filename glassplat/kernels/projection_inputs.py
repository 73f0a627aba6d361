"""What projections take, of ellipsoids and of discs: checked, and with what a batch of cameras may leave out."""

from __future__ import annotations

from torch import Tensor

from glassplat.kernels.maths.harmonics import check_sh_degree
from glassplat.kernels.records import CameraBatch, RawGaussians, check_tensors


def projection_inputs(
    gaussians: RawGaussians, cameras: CameraBatch, *, scales: int, sh_degree: int, near: float
) -> tuple[Tensor, ...]:
    """The raw tensors, poses [C, 4, 4], intrinsics [C, 4], clip planes [C or 0, 4] and windows [C, 4].

    Args:
        gaussians: raw tensors, float32 or float64.
        cameras: of the same floating-point type.
        scales: how many a Gaussian has.
        sh_degree: highest degree of the spherical harmonics to evaluate.
        near: smallest depth.

    Raises:
        ValueError: a shape, the degree or `near` is out of range.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    _check(gaussians, cameras, scales)
    check_sh_degree(sh_degree, gaussians.sh.shape[1])
    if not near >= 0:
        raise ValueError(f"near is {near}; expected a depth of at least 0")
    clip_planes = cameras.clip_planes
    if clip_planes is None:
        clip_planes = gaussians.means.new_empty(0, 4)
    windows = _whole_images(cameras) if cameras.windows is None else cameras.windows
    return (*gaussians, cameras.cam_from_world, cameras.intrinsics, clip_planes, windows)


def _whole_images(cameras: CameraBatch) -> Tensor:
    """Windows of all pixels, filled in on the device: numbers that came from here would make it wait."""
    windows = cameras.cam_from_world.new_zeros(cameras.cam_from_world.shape[0], 4)
    windows[:, 2].fill_(cameras.width)
    windows[:, 3].fill_(cameras.height)
    return windows


def _check(gaussians: RawGaussians, cameras: CameraBatch, scales: int) -> None:
    count, num_cameras = gaussians.means.shape[0], cameras.cam_from_world.shape[0]
    coefficients = gaussians.sh.shape[1] if gaussians.sh.dim() == 3 else 0
    expected = {
        "means": (gaussians.means, (count, 3)),
        "quats": (gaussians.quats, (count, 4)),
        "log_scales": (gaussians.log_scales, (count, scales)),
        "logit_opacities": (gaussians.logit_opacities, (count,)),
        "sh": (gaussians.sh, (count, coefficients, 3)),
        "cam_from_world": (cameras.cam_from_world, (num_cameras, 4, 4)),
        "intrinsics": (cameras.intrinsics, (num_cameras, 4)),
    }
    if cameras.clip_planes is not None:
        expected["clip_planes"] = (cameras.clip_planes, (num_cameras, 4))
    if cameras.windows is not None:
        expected["windows"] = (cameras.windows, (num_cameras, 4))
    check_tensors(expected)
