"""Records about flat panes that the kernel operations hand to each other."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Panes(NamedTuple):
    """K rectangles in the camera frame.

    centers [K, 3]; normals [K, 3] and in-plane axes [K, 2, 3], all of unit length; half_sizes [K, 2] along the axes.
    """

    centers: Tensor
    normals: Tensor
    axes: Tensor
    half_sizes: Tensor


class PaneHits(NamedTuple):
    """Which pane each pixel shows.

    pane [H, W] int32: the nearest pane that the pixel's ray meets, -1 where there is none.
    depth [H, W]: where it does, infinite where there is none.
    tiles [K, rows, columns] bool: tiles in which a pixel shows the pane.
    windows [K, 4]: left, top, right and bottom edge, in pixels, of the pixels that show it; all 0 where none does.
    """

    pane: Tensor
    depth: Tensor
    tiles: Tensor
    windows: Tensor


class BlendedPanes(NamedTuple):
    """An image with its panes: rgb and reflection [H, W, 3] sRGB, strength [H, W]."""

    rgb: Tensor
    reflection: Tensor
    strength: Tensor
