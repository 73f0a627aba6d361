"""Layers of panes on the CPU: each row and the two next to it."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from glassplat.kernels.backend.cpu import Kernel, kernel


@cache
def pane_layers_kernel(real: type) -> Kernel:
    """Fills both images [H, W]."""
    zero, one, nothing = real(0.0), real(1.0), np.int32(-1)

    @kernel("pane_layers", real)
    def layers(pane, strength, hit, inner):
        height, width = pane.shape
        for row in prange(height):
            # One pixel more on either side.
            alike: NDArray[Any] = np.ones(width + 2, np.bool_)
            own: NDArray[Any] = np.empty(width, np.int32)
            for x in range(width):
                own[x] = pane[row, x] if strength[row, x] > zero else nothing
                hit[row, x] = one if pane[row, x] >= 0 else zero
                alike[x + 1] = own[x] >= 0
            for other in range(max(0, row - 1), min(height, row + 2)):
                if other != row:
                    for x in range(width):
                        shown = pane[other, x] if strength[other, x] > zero else nothing
                        alike[x + 1] &= shown == own[x]
            for x in range(width):
                left, right = own[max(x - 1, 0)], own[min(x + 1, width - 1)]
                same = (left == own[x]) & (right == own[x]) & alike[x] & alike[x + 1] & alike[x + 2]
                inner[row, x] = one if same else zero

    return layers
