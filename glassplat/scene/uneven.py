"""Uneven glass: the heights of a pane's surface above its plane, and the slopes that turn its normals.

Heights are cubic B-splines: a few control values for each pane, evenly spread over its rectangle and a little beyond.
"""

from __future__ import annotations

import torch
from torch import Tensor

LEAST_HEIGHTS = 4
"""Along each side: what one piece of a cubic spline takes."""


def without_tilt(heights: Tensor) -> Tensor:
    """Heights [K, R, C] less the plane that fits each pane's best: turning a pane is its normal's business."""
    down, along = (_centred(count, heights) for count in heights.shape[1:])
    down, along = down[:, None], along[None, :]
    level = heights - heights.mean(dim=(1, 2), keepdim=True)
    for ramp in (down.expand(heights.shape[1:]), along.expand(heights.shape[1:])):
        level = level - (level * ramp).sum(dim=(1, 2), keepdim=True) / ramp.square().sum() * ramp
    return level


def _centred(count: int, like: Tensor) -> Tensor:
    return torch.arange(count, dtype=like.dtype, device=like.device) - (count - 1) / 2


def slopes_at(heights: Tensor, panes: Tensor, places: Tensor) -> Tensor:
    """[N, 2] how steeply glass rises along a pane's first and second side, where -1 to 1 is a side's length.

    Differentiable in the heights, with the same bits for any number of threads.

    Args:
        heights: [K, R, C] control values; rows are spread along the second side, columns along the first.
        panes: [N] which pane.
        places: [N, 2] where on it, -1 to 1 along the first and the second side; what is beyond is taken for the rim.
    """
    rows, columns = heights.shape[1:]
    first, along, rises_along = _pieces(places[:, 0], columns)
    top, down, rises_down = _pieces(places[:, 1], rows)
    steps = torch.arange(LEAST_HEIGHTS, device=heights.device)
    cell = (panes * rows + top)[:, None, None] + steps[:, None]
    # An embedding's gradient has the same bits for any number of threads, that of an index has not.
    index = cell * columns + first[:, None, None] + steps
    near = torch.nn.functional.embedding(index, heights.reshape(-1, 1)).squeeze(-1)
    products = torch.stack([_outer(down, rises_along), _outer(rises_down, along)], dim=1)
    return (near[:, None] * products).sum(dim=(2, 3))


def _outer(down: Tensor, along: Tensor) -> Tensor:
    return down[:, :, None] * along[:, None, :]


def _pieces(place: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The first of four control values on which a place [N] depends, their weights [N, 4], and how these change."""
    pieces = count - LEAST_HEIGHTS + 1
    position = (place.clamp(-1, 1) + 1) / 2 * pieces
    first = position.floor().clamp(max=pieces - 1)
    t = position - first
    s = 1 - t
    weights = torch.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], dim=-1) / 6
    rises = torch.stack([-(s**2), 3 * t**2 - 4 * t, 4 * s - 3 * s**2, t**2], dim=-1) / 2 * (pieces / 2)
    return first.long(), weights, rises


def mean_square_slopes(heights: Tensor, half_sizes: Tensor) -> Tensor:
    """[K] mean over each pane of the square of the angle by which its normals are turned, radians.

    From differences of neighbouring control values.

    Args:
        heights: [K, R, C] control values, world units.
        half_sizes: [K, 2] of the panes.
    """
    squares = []
    for axis, half in ((2, half_sizes[:, 0]), (1, half_sizes[:, 1])):
        spacing = 2 * half / (heights.shape[axis] - LEAST_HEIGHTS + 1)
        squares.append((heights.diff(dim=axis) / spacing[:, None, None]).square().mean(dim=(1, 2)))
    return squares[0] + squares[1]
