"""What boxes hold: how far a Gaussian reaches along the axes, and how many nodes there are."""

from __future__ import annotations

import math

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.trace.steps import WIDTH


def level_offsets(count: int) -> list[int]:
    """Where the nodes of each level over `count` Gaussians begin, the lowest first, and where the last one ends."""
    offsets = [0]
    while count > 1 or (count == 1 and len(offsets) == 1):
        count = -(-count // WIDTH)
        offsets.append(offsets[-1] + count)
    return offsets


def half_widths_maths(real: type, flat: bool) -> Scalar:
    """Builds (x, y, z): half the size of a Gaussian's box, from its frame and how many deviations it reaches."""
    zero, one = real(0.0), real(1.0)

    @inlined
    def squares(frames, g, axis):  # type: ignore[no-untyped-def]
        x, y, z = frames[g, axis, 0], frames[g, axis, 1], frames[g, axis, 2]
        # A row is an axis divided by its deviation; divided by its squared length it is their product.
        inverse = one / (x * x + y * y + z * z)
        x, y, z = x * inverse, y * inverse, z * inverse
        return x * x, y * y, z * z

    @inlined
    def half_widths(frames, g, extent):  # type: ignore[no-untyped-def]
        u, v = squares(frames, g, 0), squares(frames, g, 1)
        w = (zero, zero, zero) if flat else squares(frames, g, 2)
        x, y, z = u[0] + v[0] + w[0], u[1] + v[1] + w[1], u[2] + v[2] + w[2]
        return extent * real(math.sqrt(x)), extent * real(math.sqrt(y)), extent * real(math.sqrt(z))

    return half_widths
