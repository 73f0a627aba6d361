"""Scalar maths of blending: the coverage of a pixel by a splat, and the image rows that a splat can reach.

Every function is pure and, if it has constants that single precision rounds, typed by its factory: np.float32 or
np.float64. So one source compiles for the CPU and for CUDA.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from glassplat.kernels.backend.cpu import inlined

ALPHA_MIN = 1.0 / 255.0
"""Coverage below this is ignored."""
ALPHA_MAX = 0.99
"""Upper bound of coverage, so that no single splat blocks all light."""
TRANSMITTANCE_MIN = 1e-4
"""Blending of a pixel stops before the splat that would reduce its transmittance below this."""

# Minimax polynomial of 2^f for f in [-1, 0] with 2^0 = 1 exactly; relative error 2.4e-7 in float32.
EXP2_COEFFICIENTS = (1.0, 0.693143721, 0.240180143, 0.0552973572, 0.00920579680, 0.000944903083)

Scalar = Callable[..., Any]


def build_exp2(real: type) -> Scalar:
    """Builds 2^t for t <= 0. NaN and anything below -80 give 2^-80, which is far below `ALPHA_MIN`."""
    c0, c1, c2, c3, c4, c5 = (real(c) for c in EXP2_COEFFICIENTS)
    lowest, natural = real(-80.0), real(math.log(2.0))

    @inlined
    def fast_exp2(t):
        # This order of the comparison maps NaN to the lowest value too.
        t = t if t > lowest else lowest
        # Truncation towards zero is one vector instruction; math.floor would widen to 64 bits.
        whole = np.int32(t)
        f = t - real(whole)
        fraction = ((((c5 * f + c4) * f + c3) * f + c2) * f + c1) * f + c0
        power = np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)
        return fraction * power

    @inlined
    def exact_exp2(t):
        t = t if t > lowest else lowest
        return real(math.exp(t * natural))

    return fast_exp2 if real is np.float32 else exact_exp2


def build_screen_form(real: type) -> Scalar:
    """Builds the scaling of a conic such that a Gaussian falls off as 2^(quadratic form of the offset)."""
    bits = real(-1.0 / math.log(2.0))
    half_bits = real(-0.5 / math.log(2.0))

    @inlined
    def screen_form(conic_xx, conic_xy, conic_yy):
        return half_bits * conic_xx, bits * conic_xy, half_bits * conic_yy

    return screen_form


def build_vertical_reach(real: type) -> Scalar:
    """Builds the distance in rows from its centre at which a splat's coverage drops to `ALPHA_MIN`.

    It is negative if the splat reaches no pixel.
    """
    zero, one, two, nothing = real(0.0), real(1.0), real(2.0), real(-1.0)
    inverse_alpha_min, slack, endless = real(1.0 / ALPHA_MIN), real(1e-3), real(np.inf)

    @inlined
    def vertical_reach(conic_xx, conic_xy, conic_yy, opacity):
        # In double precision, because the determinant of a needle's conic is a small difference of large products.
        xx, xy = np.float64(conic_xx), np.float64(conic_xy)
        determinant = xx * np.float64(conic_yy) - xy * xy
        visible = inverse_alpha_min * opacity
        # Written so that any NaN results in "reaches nothing".
        if not (determinant > 0.0 and conic_xx > zero and one < visible < endless):
            return nothing
        return real(math.sqrt(two * math.log(visible) * real(xx / determinant))) + slack

    return vertical_reach


def build_row_range(real: type) -> Scalar:
    """Builds the first and one-past-last of the rows 0 .. count - 1 that a splat reaches."""
    half, zero = real(0.5), real(0.0)

    @inlined
    def row_range(center, reach, count):
        # Row r is sampled at r + 0.5. Clamping before the conversion keeps infinite reaches well defined.
        low, high, bottom = center - reach - half, center + reach - half, real(count - 1)
        if not (reach >= zero and high >= zero and low <= bottom):
            return np.int32(0), np.int32(0)
        low = low if low > zero else zero
        high = high if high < bottom else bottom
        return np.int32(math.ceil(low)), np.int32(high) + np.int32(1)

    return row_range


def build_reached_rows(real: type) -> Scalar:
    """Builds the rows 0 .. count - 1 that a splat reaches, as bits."""
    vertical_reach, row_range = build_vertical_reach(real), build_row_range(real)

    @inlined
    def reached_rows(center, conic_xx, conic_xy, conic_yy, opacity, count):
        first, last = row_range(center, vertical_reach(conic_xx, conic_xy, conic_yy, opacity), count)
        return np.int32((1 << last) - (1 << first))

    return reached_rows
