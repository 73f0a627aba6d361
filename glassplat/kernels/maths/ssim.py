"""Scalar maths of structural similarity: the window, and the similarity of two pixels from their blurred surroundings.

Every function is pure and typed by its factory, so that one source compiles for the CPU and for CUDA.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths.blending import Scalar

RADIUS = 5
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


class SsimMaths(NamedTuple):
    """Scalar functions of structural similarity for one floating-point type.

    Attributes:
        blur: weighted sum of 11 values of an array, `step` apart, the first of them at `at`.
        compare: similarity of two pixels a and b (Wang et al. 2004, Eq. 13), and its slopes by the blurred a, by the
            blurred sum of squares a^2 + b^2 and by the blurred product a b, from those and the blurred b.
    """

    blur: Scalar
    compare: Scalar


def ssim_maths(real: type) -> SsimMaths:
    """Builds the functions for `real`, np.float32 or np.float64."""
    return SsimMaths(_blur(real), _compare(real))


def window() -> list[float]:
    """The 11 weights of the Gaussian window; they sum to one."""
    weights = [math.exp(-0.5 * (offset / SIGMA) ** 2) for offset in range(-RADIUS, RADIUS + 1)]
    return [weight / sum(weights) for weight in weights]


def _blur(real: type) -> Scalar:
    w0, w1, w2, w3, w4, w5 = (real(weight) for weight in window()[: RADIUS + 1])

    @inlined
    def blur(values, at, step):  # type: ignore[no-untyped-def]
        outer = w0 * (values[at] + values[at + 10 * step]) + w1 * (values[at + step] + values[at + 9 * step])
        middle = w2 * (values[at + 2 * step] + values[at + 8 * step]) + w3 * (
            values[at + 3 * step] + values[at + 7 * step]
        )
        return outer + middle + w4 * (values[at + 4 * step] + values[at + 6 * step]) + w5 * values[at + 5 * step]

    return blur


def _compare(real: type) -> Scalar:
    one, two, c1, c2 = real(1.0), real(2.0), real(C1), real(C2)

    @inlined
    def compare(mean_a, mean_b, squares, product):  # type: ignore[no-untyped-def]
        means, mean_squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
        a1, a2 = two * means + c1, two * (product - means) + c2
        b1, b2 = one / (mean_squares + c1), one / (squares - mean_squares + c2)
        value = a1 * a2 * b1 * b2
        by_mean = two * (mean_b * (a2 - a1) * b1 * b2 + mean_a * value * (b2 - b1))
        return value, by_mean, -value * b2, two * a1 * b1 * b2

    return compare
