"""An order of points along a curve on which neighbours in space are neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

BITS = 21
"""Bits for each axis: three times as many fit into an integer of 64 bits with a sign."""
_SPREADS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


@torch.no_grad()
def morton_codes(means: Tensor) -> Tensor:
    """[N] int64: place of each point [N, 3] along a Morton curve (Z-order) through their bounding cube.

    What is not finite comes last.
    """
    finite = means.isfinite().all(dim=1)
    if not bool(finite.any()):
        return torch.zeros(means.shape[0], dtype=torch.int64, device=means.device)
    lowest, highest = means[finite].amin(dim=0), means[finite].amax(dim=0)
    size = (highest - lowest).amax().clamp(min=torch.finfo(means.dtype).tiny)
    cells = ((means - lowest).double() / size.double() * (2**BITS - 1)).nan_to_num().long().clamp(0, 2**BITS - 1)
    for shift, mask in _SPREADS:
        cells = (cells | (cells << shift)) & mask
    codes = cells[:, 0] | (cells[:, 1] << 1) | (cells[:, 2] << 2)
    return torch.where(finite, codes, torch.iinfo(torch.int64).max)
