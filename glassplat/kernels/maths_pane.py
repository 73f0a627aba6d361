"""Scalar maths of a flat pane: where rays meet it, and how strongly it reflects.

Rays are (x, y, 1) in the camera frame. Every function is pure and typed by its factory, so that one source compiles for
the CPU and for CUDA.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.maths_blend import Scalar


class PaneMaths(NamedTuple):
    """Scalar functions of panes for one floating-point type.

    Attributes:
        schlick: strength R0 + (1 - R0) (1 - c)^5 for a cosine c (TR-Gaussians, Eq. 6).
        schlick_slopes: derivatives of `schlick` by R0 and by the cosine.
        ray_length: length of the ray (x, y, 1).
    """

    schlick: Scalar
    schlick_slopes: Scalar
    ray_length: Scalar


def pane_maths(real: type) -> PaneMaths:
    """Builds the functions for `real`, np.float32 or np.float64."""
    zero, one, five = real(0.0), real(1.0), real(5.0)

    @inlined
    def schlick(base, cosine):  # type: ignore[no-untyped-def]
        grazing = one - (cosine if cosine < one else one)
        squared = grazing * grazing
        return base + (one - base) * squared * squared * grazing

    @inlined
    def schlick_slopes(base, cosine):  # type: ignore[no-untyped-def]
        grazing = one - (cosine if cosine < one else one)
        squared = grazing * grazing
        fourth = squared * squared
        return one - fourth * grazing, -five * (one - base) * fourth if cosine < one else zero

    @inlined
    def ray_length(x, y):  # type: ignore[no-untyped-def]
        return real(math.sqrt(x * x + y * y + one))

    return PaneMaths(schlick, schlick_slopes, ray_length)
