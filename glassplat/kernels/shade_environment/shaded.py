"""The record of a shaded image."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

NORMAL_MIN = 1e-6
"""A blended normal that is shorter has no direction."""


NORMAL_AT, STRENGTH_AT, SURFACE_CHANNELS = 3, 6, 7
"""Channels of blended surfaces: colour before the normal, then strength; others may follow."""


class Shaded(NamedTuple):
    """An image, what it shows without reflection, and what it mirrors: rgb, base and reflection [H, W, 3] sRGB."""

    rgb: Tensor
    base: Tensor
    reflection: Tensor
