"""Which pane each pixel shows."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.bin_tiles import tile_grid
from glassplat.kernels.cpu.pane_hits import pane_hits_forward
from glassplat.kernels.panes import PaneHits, Panes
from glassplat.kernels.tensor_checks import REAL_OF, check_tensors


@torch.no_grad()
def pane_hits(panes: Panes, intrinsics: Tensor, width: int, height: int, mask: Tensor | None = None) -> PaneHits:
    """Finds the nearest pane along the ray of every pixel centre (H_k of TR-Gaussians, Section III-A2).

    Not differentiable: piecewise constant in everything.

    Args:
        panes: rectangles in the camera frame, seen from either side.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        width: of the image, pixels.
        height: of the image, pixels.
        mask: [H, W] visibility of the panes; where it is 0, `tiles` and `windows` leave the pixel out.

    Raises:
        ValueError: shapes disagree.
        TypeError: tensors of different or unsupported floating-point types, or not on the CPU.
    """
    count = panes.centers.shape[0]
    expected = {
        "centers": (panes.centers, (count, 3)),
        "normals": (panes.normals, (count, 3)),
        "axes": (panes.axes, (count, 2, 3)),
        "half_sizes": (panes.half_sizes, (count, 2)),
        "intrinsics": (intrinsics, (4,)),
    }
    if mask is not None:
        expected["mask"] = (mask, (height, width))
    check_tensors(expected)
    index = torch.empty(height, width, dtype=torch.int32)
    tiles = torch.zeros(count, *tile_grid(width, height), dtype=torch.bool)
    windows = panes.centers.new_zeros(count, 4)
    visible = panes.centers.new_empty(0, 0) if mask is None else mask
    inputs = (*panes, intrinsics, visible)
    pane_hits_forward(REAL_OF[panes.centers.dtype])(
        *(tensor.detach().contiguous().numpy() for tensor in inputs), index.numpy(), tiles.numpy(), windows.numpy()
    )
    return PaneHits(index, tiles, windows)
