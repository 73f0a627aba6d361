"""Which pane each pixel shows."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.devices import kernels_for
from glassplat.kernels.panes import PaneHits, Panes
from glassplat.kernels.tensor_checks import check_tensors


@torch.no_grad()
def pane_hits(
    panes: Panes,
    intrinsics: Tensor,
    width: int,
    height: int,
    mask: Tensor | None = None,
    *,
    beyond: PaneHits | None = None,
) -> PaneHits:
    """Finds the nearest pane along the ray of every pixel centre (H_k of TR-Gaussians, Section III-A2).

    Not differentiable: piecewise constant in everything.

    Args:
        panes: rectangles in the camera frame, seen from either side.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        width: of the image, pixels.
        height: of the image, pixels.
        mask: [H, W] visibility of the panes; where it is 0, `tiles` and `windows` leave the pixel out.
        beyond: hits with the same panes and camera; the nearest pane after them is sought, and none where they have
            none. Called with its own results, this finds all panes along a ray, one after another.

    Raises:
        ValueError: shapes disagree.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
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
    if beyond is not None:
        expected["beyond.depth"] = (beyond.depth, (height, width))
    check_tensors(expected)
    inputs = [tensor.detach().contiguous() for tensor in (*panes, intrinsics)]
    visible = None if mask is None else mask.detach().contiguous()
    hits: PaneHits = kernels_for("pane_hits", intrinsics.device).pane_hits(inputs, width, height, visible, beyond)
    return hits
