"""Scalar maths of discs on screen (2DGS): intersection with a pixel's ray, the covered region, and the adjoints.

A disc has a centre m and two unit tangents p, q in camera space, with the standard deviations s_u, s_v along them. The
ray through the pixel at offset (dx, dy) from the projected centre meets its plane at m + u s_u p + v s_v q with

    u = (u_x dx + u_y dy) / e,   v = (v_x dx + v_y dy) / e,   e = 1 + w_x dx + w_y dy,   depth = m_z / e

Relative to the centre, none of these suffers from cancellation, however small the disc. The six numbers u_x, u_y, v_x,
v_y, w_x, w_y are its *map*.

Every function is pure and, if it has constants that single precision rounds, typed by its factory: one source compiles
for the CPU and for CUDA.
"""

from __future__ import annotations

import math

import numpy as np

from glassplat.kernels.backend.cpu import ONE, ZERO, inlined
from glassplat.kernels.maths.blending import ALPHA_MIN, Scalar
from glassplat.kernels.maths.projection import combine, cross, dot, dot_products, scaled, scaled_sum

EDGE_ON = 1e-3
"""Cosine between ray and normal below which a disc is seen edge-on and not intersected."""
MOST_LOG_SCALE = 40.0
"""Maximum magnitude of a log scale: beyond it, squared deviations or their inverses leave the range of float32."""
MOST_DEVIATIONS = 3.0
"""Distance from its centre, in standard deviations, at which a Gaussian is cut off (EnvGS, Section 4.2)."""


def ray_hit_maths(real: type, flat: bool) -> tuple[Scalar, Scalar]:
    """Builds the intersection of a ray with a disc (`flat`) or ellipsoid, and its adjoint.

    Vectors are tuples, a frame is a tuple of three rows. `intersect` returns (t, q, squared |q|) from offset (centre
    minus origin), direction and frame; t is not finite where the two do not meet. `intersect_gradient` returns those of
    (origin, direction, frame rows) from those of t and of squared |q|; the centre's is the negative of the origin's.
    """
    return _disc(real) if flat else _ellipsoid(real)


def _disc(real: type) -> tuple[Scalar, Scalar]:
    zero, one, two, nowhere, edge_on = real(0.0), real(1.0), real(2.0), real("inf"), real(EDGE_ON)

    @inlined
    def intersect(offset, d, frame):
        slope = dot(frame[2], d)
        if not slope * slope > edge_on * edge_on * dot(d, d):
            return nowhere, (zero, zero, zero), nowhere
        t = dot(frame[2], offset) / slope
        x = combine(t, d, -one, offset)
        u, v = dot(frame[0], x), dot(frame[1], x)
        return t, (u, v, zero), u * u + v * v

    @inlined
    def intersect_gradient(offset, d, frame, t, q, v_t, v_squared):
        inverse_slope = one / dot(frame[2], d)
        x = combine(t, d, -one, offset)
        v_u, v_v = two * v_squared * q[0], two * v_squared * q[1]
        v_x = combine(v_u, frame[0], v_v, frame[1])
        along_normal = (v_t + dot(v_x, d)) * inverse_slope
        v_origin = combine(one, v_x, -along_normal, frame[2])
        return v_origin, scaled(t, v_origin), (scaled(v_u, x), scaled(v_v, x), scaled(-along_normal, x))

    return intersect, intersect_gradient


def _ellipsoid(real: type) -> tuple[Scalar, Scalar]:
    zero, one, two, nowhere = real(0.0), real(1.0), real(2.0), real("inf")

    @inlined
    def across(q, f, length):
        """Component of q perpendicular to the ray: all of q, apart from rounding.

        Across a thin ellipsoid q is a difference of numbers as large as the inverse of its thickness. Gradients
        multiply its rounding error by the same factor again.
        """
        return combine(one, q, -dot(q, f) / length, f)

    @inlined
    def intersect(offset, d, frame):
        e, f = dot_products(offset, frame), dot_products(d, frame)
        length = dot(f, f)
        if not length > zero:
            return nowhere, (zero, zero, zero), nowhere
        t = dot(e, f) / length
        q = across(combine(t, f, -one, e), f, length)
        return t, q, dot(q, q)

    @inlined
    def intersect_gradient(offset, d, frame, t, q, v_t, v_squared):
        e, f = dot_products(offset, frame), dot_products(d, frame)
        length = dot(f, f)
        # Repeated, because the first projection leaves a rounding error of its own.
        q = across(q, f, length)
        # The derivative of |q| with respect to t is zero, because t minimises |q|.
        by_t = v_t / length
        v_e = combine(-two * v_squared, q, by_t, f)
        reflected = e[0] - two * t * f[0], e[1] - two * t * f[1], e[2] - two * t * f[2]
        v_f = combine(two * v_squared * t, q, by_t, reflected)
        v_offset, v_d = scaled_sum(v_e, frame), scaled_sum(v_f, frame)
        v_frame = (
            combine(v_e[0], offset, v_f[0], d),
            combine(v_e[1], offset, v_f[1], d),
            combine(v_e[2], offset, v_f[2], d),
        )
        return (-v_offset[0], -v_offset[1], -v_offset[2]), v_d, v_frame

    return intersect, intersect_gradient


LOW_PASS = math.sqrt(0.5)
"""Standard deviation in pixels of the screen-space low-pass filter around a disc's centre (2DGS, Eq. 11)."""
MAP = 6
"""Number of values in a map: u_x, u_y, v_x, v_y, w_x, w_y."""
SLACK = 1.002
"""Factor by which an outline is wider than the region it encloses, so that no pixel is lost to rounding."""


def build_is_not_edge_on(real: type) -> Scalar:
    """Builds the test that a disc is not seen edge-on, from p x q and the centre."""
    edge_on, largest = real(EDGE_ON), real(np.finfo(real).max)

    @inlined
    def is_not_edge_on(n, m):
        slope = dot(n, m)
        # Written so that NaN fails the comparison.
        return edge_on * edge_on * dot(n, n) * dot(m, m) < slope * slope <= largest

    return is_not_edge_on


@inlined
def pixel_map(p, q, n, m, inverse_u, inverse_v, fx, fy):
    """The map of a disc, from its tangents, p x q, centre, inverse deviations and focal lengths."""
    k, a, b = m[2] / dot(n, m), cross(q, m), cross(m, p)
    x, y = k / fx, k / fy
    return a[0] * inverse_u * x, a[1] * inverse_u * y, b[0] * inverse_v * x, b[1] * inverse_v * y, n[0] * x, n[1] * y


@inlined
def plus(a, b):
    """The sum a + b."""
    return combine(ONE, a, ONE, b)


@inlined
def map_gradient(p, q, m, n, found, inverse_u, inverse_v, fx, fy, g):
    """Gradients of tangents, centre and the logarithms of the deviations, from those of the map."""
    slope = dot(n, m)
    k = m[2] / slope
    x, y = k / fx, k / fy
    along_u, along_v = g[0] * found[0] + g[1] * found[1], g[2] * found[2] + g[3] * found[3]
    total = along_u + along_v + g[4] * found[4] + g[5] * found[5]
    g_a = g[0] * inverse_u * x, g[1] * inverse_u * y, ZERO
    g_b = g[2] * inverse_v * x, g[3] * inverse_v * y, ZERO
    g_slope = -total / slope
    g_n = combine(g_slope, m, ONE, (g[4] * x, g[5] * y, ZERO))
    g_p = plus(cross(g_b, m), cross(q, g_n))
    g_q = plus(cross(m, g_a), cross(g_n, p))
    g_m = combine(g_slope, n, ONE, plus(cross(g_a, q), cross(p, g_b)))
    return g_p, g_q, (g_m[0], g_m[1], g_m[2] + total / m[2]), -along_u, -along_v


# The region of the screen that a disc covers, as an ellipse for `bin_tiles`, in double precision.


@inlined
def reach(opacity):
    """Squared distance, in standard deviations, up to which a disc of this opacity is visible; negative for none."""
    visible = np.float64(opacity) / ALPHA_MIN
    if not visible > 1.0:
        return -1.0
    return min(2.0 * math.log(visible), MOST_DEVIATIONS * MOST_DEVIATIONS)


@inlined
def _clamped_ellipse(xx, xy, yy, least):
    """An ellipse {d : d^T S^-1 d <= 1}, with half axes of at least the root of `least`, widened by `SLACK`."""
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    apart = math.sqrt(half * half + xy * xy)
    large, small = max(middle + apart, least), max(middle - apart, least)
    # S = mean of the eigenvalues + half their difference along the axes.
    center, share = 0.5 * (large + small), 0.0
    if apart > 0.0:
        share = 0.5 * (large - small) / apart
    wider = SLACK * SLACK
    return wider * (center + share * half), wider * share * xy, wider * (center - share * half)


@inlined
def outline(found, opacity, nearest, near, width, height):
    """An ellipse that encloses the region covered by the disc: (dx, dy, xx, xy, yy, half width, half height).

    Its centre is an offset from the disc's, and its conic is scaled such that opacity exp(-q / 2) is 1/255 on it. A
    conic of zeros means the whole image, for a disc that crosses the near plane. `nearest` is the smallest depth in the
    region.
    """
    squared = reach(opacity)
    u_x, u_y, v_x, v_y = np.float64(found[0]), np.float64(found[1]), np.float64(found[2]), np.float64(found[3])
    w_x, w_y = np.float64(found[4]), np.float64(found[5])
    # On the contour |u|^2 + |v|^2 = squared: a quadratic form of the offset, completed to a square.
    xx = u_x * u_x + v_x * v_x - squared * w_x * w_x
    xy = u_x * u_y + v_x * v_y - squared * w_x * w_y
    yy = u_y * u_y + v_y * v_y - squared * w_y * w_y
    determinant = xx * yy - xy * xy
    if not (nearest > near and determinant > 0.0 and xx > 0.0):
        return 0.0, 0.0, 0.0, 0.0, 0.0, np.float64(width), np.float64(height)
    dx = squared * (yy * w_x - xy * w_y) / determinant
    dy = squared * (xx * w_y - xy * w_x) / determinant
    size = (squared + squared * (w_x * dx + w_y * dy)) / determinant
    least = LOW_PASS * math.sqrt(squared) + math.sqrt(dx * dx + dy * dy)
    s_xx, s_xy, s_yy = _clamped_ellipse(yy * size, -xy * size, xx * size, least * least)
    scale = 2.0 * math.log(np.float64(opacity) / ALPHA_MIN) / (s_xx * s_yy - s_xy * s_xy)
    return dx, dy, s_yy * scale, -s_xy * scale, s_xx * scale, math.sqrt(s_xx), math.sqrt(s_yy)


@inlined
def crossing_box(m, p, q, deviations, squared, near, fx, fy):
    """Bounds (left, right, top, bottom) of a disc that crosses the near plane, in pixels from the principal point.

    They enclose a rectangle in the disc's plane, with one side along the depth gradient, clipped at the near plane.
    """
    a, b = np.float64(p[2] * deviations[0]), np.float64(q[2] * deviations[1])
    steepness, depth, reach = math.sqrt(a * a + b * b), np.float64(m[2]), math.sqrt(squared)
    # However close the near plane, points at depth zero do not project.
    first, last = -reach, reach
    if steepness > 0.0:
        first = max(-reach, (max(near, 1e-6 * depth) - depth) / steepness)
        a, b = a / steepness, b / steepness
    u_x, u_y = np.float64(p[0] * deviations[0]), np.float64(p[1] * deviations[0])
    v_x, v_y = np.float64(q[0] * deviations[1]), np.float64(q[1] * deviations[1])
    along_x, along_y, across_x, across_y = (a * u_x + b * v_x, a * u_y + b * v_y, a * v_x - b * u_x, a * v_y - b * u_y)
    x, y, spot = fx * m[0] / depth, fy * m[1] / depth, LOW_PASS * reach
    left, right, top, bottom = x - spot, x + spot, y - spot, y + spot
    for end in range(2):
        way = first if end == 0 else last
        behind = depth + way * steepness
        x, y = fx * (m[0] + way * along_x) / behind, fy * (m[1] + way * along_y) / behind
        wide, high = abs(fx * reach * across_x / behind), abs(fy * reach * across_y / behind)
        left, right, top, bottom = (
            min(left, x - wide),
            max(right, x + wide),
            min(top, y - high),
            max(bottom, y + high),
        )
    return left, right, top, bottom


@inlined
def intersect(found, dx, dy):
    """The numerators of u and v, and e, of a map at offsets or vectors of them (`backend/cpu_vector.py`)."""
    u_x, u_y, v_x, v_y, w_x, w_y = found
    return dx * u_x + dy * u_y, dx * v_x + dy * v_y, dx * w_x + dy * w_y + ONE


@inlined
def offset_gradient(found, g_u, g_v, g_e):
    """The gradient of the offset from those of the results of `intersect`."""
    u_x, u_y, v_x, v_y, w_x, w_y = found
    return g_u * u_x + g_v * v_x + g_e * w_x, g_u * u_y + g_v * v_y + g_e * w_y
