"""Scalar maths of a ray that meets a Gaussian: where, how near to its centre, and the adjoint.

A Gaussian is its centre and a frame of three rows. Of a *disc* (2DGS) two rows are its axes divided by their standard
deviations, and the third is its unit normal; of an *ellipsoid* (3DGS) all three are axes. A disc is met where its plane
is, an ellipsoid where its density is largest along the ray. `q` is that place in units of standard deviations.
"""

from __future__ import annotations

from typing import NamedTuple

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.projection import vector_maths

EDGE_ON = 1e-3
"""Cosine between ray and normal below which a disc is seen from its edge and not met."""
MOST_LOG_SCALE = 40.0
"""Beyond, squares of deviations and of their inverses leave the range of float32."""
MOST_DEVIATIONS = 3.0
"""Distance from its centre, in standard deviations, at which a Gaussian ends (EnvGS, Section 4.2)."""


class RayHitMaths(NamedTuple):
    """Steps for one ray and one Gaussian; vectors are tuples, a frame is a tuple of three rows.

    Attributes:
        meet: (t, q, squared |q|) from offset (centre minus origin), direction and frame; t is not finite where the two
            do not meet.
        meet_gradient: gradients (origin, direction, frame rows) from those of t and of squared |q|. That of the centre
            is the negative of the origin's.
    """

    meet: Scalar
    meet_gradient: Scalar


def ray_hit_maths(real: type, flat: bool) -> RayHitMaths:
    """Builds the functions for discs (`flat`) or ellipsoids."""
    return _disc(real) if flat else _ellipsoid(real)


def _disc(real: type) -> RayHitMaths:
    dot, blend = vector_maths().dot, vector_maths().blend
    zero, one, two, nowhere, edge_on = real(0.0), real(1.0), real(2.0), real("inf"), real(EDGE_ON)

    @inlined
    def meet(offset, d, frame):  # type: ignore[no-untyped-def]
        slope = dot(frame[2], d)
        if not slope * slope > edge_on * edge_on * dot(d, d):
            return nowhere, (zero, zero, zero), nowhere
        t = dot(frame[2], offset) / slope
        x = blend(t, d, -one, offset)
        u, v = dot(frame[0], x), dot(frame[1], x)
        return t, (u, v, zero), u * u + v * v

    @inlined
    def meet_gradient(offset, d, frame, t, q, v_t, v_squared):  # type: ignore[no-untyped-def]
        inverse_slope = one / dot(frame[2], d)
        x = blend(t, d, -one, offset)
        v_u, v_v = two * v_squared * q[0], two * v_squared * q[1]
        v_x = blend(v_u, frame[0], v_v, frame[1])
        along_normal = (v_t + dot(v_x, d)) * inverse_slope
        v_origin = blend(one, v_x, -along_normal, frame[2])
        v_d = t * v_origin[0], t * v_origin[1], t * v_origin[2]
        v_frame = (
            (v_u * x[0], v_u * x[1], v_u * x[2]),
            (v_v * x[0], v_v * x[1], v_v * x[2]),
            (-along_normal * x[0], -along_normal * x[1], -along_normal * x[2]),
        )
        return v_origin, v_d, v_frame

    return RayHitMaths(meet, meet_gradient)


def _ellipsoid(real: type) -> RayHitMaths:
    maths = vector_maths()
    dot, blend, along, scaled_sum = maths.dot, maths.blend, maths.along, maths.scaled_sum
    zero, one, two, nowhere = real(0.0), real(1.0), real(2.0), real("inf")

    @inlined
    def outer(a, b, v, w):  # type: ignore[no-untyped-def]
        """One row of a v^T + b w^T, for numbers a and b."""
        return a * v[0] + b * w[0], a * v[1] + b * w[1], a * v[2] + b * w[2]

    @inlined
    def across(q, f, length):  # type: ignore[no-untyped-def]
        """Part of q at right angles to the ray: all of it, apart from rounding.

        Across a thin ellipsoid q is a difference of numbers as large as the inverse of its thickness, and gradients
        multiply what rounding leaves of it by as much again.
        """
        return blend(one, q, -dot(q, f) / length, f)

    @inlined
    def meet(offset, d, frame):  # type: ignore[no-untyped-def]
        e, f = along(offset, frame[0], frame[1], frame[2]), along(d, frame[0], frame[1], frame[2])
        length = dot(f, f)
        if not length > zero:
            return nowhere, (zero, zero, zero), nowhere
        t = dot(e, f) / length
        q = across(blend(t, f, -one, e), f, length)
        return t, q, dot(q, q)

    @inlined
    def meet_gradient(offset, d, frame, t, q, v_t, v_squared):  # type: ignore[no-untyped-def]
        e, f = along(offset, frame[0], frame[1], frame[2]), along(d, frame[0], frame[1], frame[2])
        length = dot(f, f)
        # The first time leaves what is rounded of the rest itself.
        q = across(q, f, length)
        # |q| does not change with t, which is where it is least.
        by_t = v_t / length
        v_e = blend(-two * v_squared, q, by_t, f)
        v_f = blend(two * v_squared * t, q, by_t, (e[0] - two * t * f[0], e[1] - two * t * f[1], e[2] - two * t * f[2]))
        v_offset = scaled_sum(v_e, frame[0], frame[1], frame[2])
        v_d = scaled_sum(v_f, frame[0], frame[1], frame[2])
        v_frame = (
            outer(v_e[0], v_f[0], offset, d),
            outer(v_e[1], v_f[1], offset, d),
            outer(v_e[2], v_f[2], offset, d),
        )
        return (-v_offset[0], -v_offset[1], -v_offset[2]), v_d, v_frame

    return RayHitMaths(meet, meet_gradient)
