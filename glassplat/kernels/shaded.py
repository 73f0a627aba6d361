"""The record of a shaded image."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

NORMAL_MIN = 1e-6
"""A blended normal that is shorter has no direction."""


class Shaded(NamedTuple):
    """An image with what it mirrors: rgb and reflection [H, W, 3] sRGB."""

    rgb: Tensor
    reflection: Tensor
