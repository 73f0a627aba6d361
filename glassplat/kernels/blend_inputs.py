"""Checks of what the blending operations are given."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.splats import Splats, TileBins


def check_splats(splats: Splats, bins: TileBins) -> None:
    """Raises where splats and bins do not belong together, or where no kernel exists for them.

    Raises:
        TypeError: the type is neither float32 nor float64, or differs between tensors.
        ValueError: shapes disagree, or the tensors are not on the CPU.
    """
    cameras, count = splats.opacities.shape
    expected = {"means2d": (2,), "conics": (3,), "opacities": (), "depths": ()}
    for name, width in expected.items():
        check_tensor(name, getattr(splats, name), (cameras, count, *width), like=splats.means2d)
    if bins.num_cameras != cameras or len(bins.splat_offsets) != cameras * count + 1:
        raise ValueError(
            f"the bins are for {bins.num_cameras} cameras and {len(bins.splat_offsets) - 1} splats, but there are "
            f"{cameras} cameras with {count} splats each; bin these very splats with bin_tiles"
        )


def check_tensor(name: str, tensor: Tensor, shape: tuple[int, ...], *, like: Tensor) -> None:
    """Raises where a tensor's shape, type or device is not the expected one; `like` sets type and device."""
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} has shape {list(tensor.shape)}, expected {list(shape)}")
    if tensor.dtype != like.dtype or tensor.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name} is {tensor.dtype}, expected {like.dtype}; float32 and float64 are supported")
    if tensor.device.type != "cpu":
        raise ValueError(f"{name} is on {tensor.device}, but blending has a CPU kernel only; move it to the CPU")


def primary_count(num_primary: int | None, splats: Splats) -> int:
    """The number of primary splats; all of them where none is given."""
    count = splats.opacities.shape[1]
    if num_primary is None:
        return count
    if not 0 <= num_primary <= count:
        raise ValueError(f"num_primary is {num_primary}, expected between 0 and the {count} splats there are")
    return num_primary
