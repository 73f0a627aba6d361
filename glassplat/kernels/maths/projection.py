"""Scalar maths of projection: the shape of a Gaussian in the world and on screen, and the adjoints of both.

Every function is pure, takes and returns scalars and tuples of scalars, and compiles for the CPU and for CUDA. A bare
float or int literal would promote float32 to float64: functions with constants that single precision rounds, or with
roots and exponentials, are typed by their factory.
"""

from __future__ import annotations

import math

import numpy as np

from glassplat.kernels.backend.cpu import ENDLESS, ONE, TWO, inlined
from glassplat.kernels.maths.blending import ALPHA_MIN, Scalar

LOW_PASS = 0.3
"""Variance in px^2 added to every splat, so that none falls between pixel centres (3DGS)."""
TANGENT_MARGIN = 0.3
"""Margin around the image, in half image sizes, within which the Jacobian is taken at the centre (3DGS)."""


# Functions of 3-vectors, which are tuples (x, y, z) of numbers or of vectors of numbers.


@inlined
def dot(a, b):
    """The dot product a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def combine(s, a, t, b):
    """The combination s a + t b."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@inlined
def scaled(s, v):
    """The product s v."""
    return s * v[0], s * v[1], s * v[2]


@inlined
def scaled_sum(v, columns):
    """The sum x a + y b + z c for v = (x, y, z): a matrix of columns (a, b, c) times a vector."""
    a, b, c = columns
    return (
        v[0] * a[0] + v[1] * b[0] + v[2] * c[0],
        v[0] * a[1] + v[1] * b[1] + v[2] * c[1],
        v[0] * a[2] + v[1] * b[2] + v[2] * c[2],
    )


@inlined
def dot_products(v, columns):
    """The products (a . v, b . v, c . v): the transpose of that matrix times a vector."""
    return dot(columns[0], v), dot(columns[1], v), dot(columns[2], v)


@inlined
def scaled_columns(s, columns):
    """A matrix with each column multiplied by its own number."""
    return scaled(s[0], columns[0]), scaled(s[1], columns[1]), scaled(s[2], columns[2])


@inlined
def cross(a, b):
    """The cross product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def cross_squared(a, b):
    """The squared length of a x b."""
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return x * x + y * y + z * z


@inlined
def tangential(s, v, u):
    """The component of a vector v perpendicular to a unit vector u, scaled: s (v - (v . u) u)."""
    radial = dot(v, u)
    return s * (v[0] - radial * u[0]), s * (v[1] - radial * u[1]), s * (v[2] - radial * u[2])


# From raw parameters to a Gaussian's opacity and principal axes, and back.


@inlined
def is_finite(x):
    """Return whether a value is neither NaN nor infinite."""
    return abs(x) < ENDLESS


def build_sigmoid(real: type) -> Scalar:
    """Builds 1 / (1 + exp(-x))."""
    one = real(1.0)

    @inlined
    def sigmoid(x):
        return one / (one + math.exp(-x))

    return sigmoid


def build_unit_quat(real: type) -> Scalar:
    """Builds the normalised quaternion `wxyz`, and the inverse norm.

    The latter is not finite or is zero if the quaternion has no direction.
    """
    one = real(1.0)

    @inlined
    def unit_quat(w, x, y, z):
        inverse_norm = one / math.sqrt(w * w + x * x + y * y + z * z)
        return (w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm), inverse_norm

    return unit_quat


@inlined
def rotation(quat):
    """Columns of the rotation matrix of a unit quaternion."""
    w, x, y, z = quat
    return (
        (ONE - TWO * (y * y + z * z), TWO * (x * y + w * z), TWO * (x * z - w * y)),
        (TWO * (x * y - w * z), ONE - TWO * (x * x + z * z), TWO * (y * z + w * x)),
        (TWO * (x * z + w * y), TWO * (y * z - w * x), ONE - TWO * (x * x + y * y)),
    )


@inlined
def unit_quat_gradient(quat, inverse_norm, g_columns):
    """Gradient of the raw quaternion from those of the three columns of its rotation."""
    (w, x, y, z), (g0, g1, g2) = quat, g_columns
    gw = x * (g1[2] - g2[1]) + y * (g2[0] - g0[2]) + z * (g0[1] - g1[0])
    gx = y * (g1[0] + g0[1]) + z * (g2[0] + g0[2]) + w * (g1[2] - g2[1]) - TWO * x * (g1[1] + g2[2])
    gy = x * (g1[0] + g0[1]) + z * (g2[1] + g1[2]) + w * (g2[0] - g0[2]) - TWO * y * (g0[0] + g2[2])
    gz = x * (g2[0] + g0[2]) + y * (g2[1] + g1[2]) + w * (g0[1] - g1[0]) - TWO * z * (g0[0] + g1[1])
    # The norm of the raw quaternion has no effect, so its direction is taken out of the gradient.
    radial = w * gw + x * gx + y * gy + z * gz
    scale = TWO * inverse_norm
    return scale * (gw - radial * w), scale * (gx - radial * x), scale * (gy - radial * y), scale * (gz - radial * z)


# EWA projection of principal axes to a screen ellipse, and its adjoint.


@inlined
def clamp(x, lowest, highest):
    """A value clamped to two limits."""
    return min(max(x, lowest), highest)


@inlined
def footprint(rows, scale_x, scale_y, tangent_x, tangent_y):
    """World vectors (w_x, w_y) whose dot products with a displacement are its pixels on screen."""
    w_x = combine(scale_x, rows[0], -scale_x * tangent_x, rows[2])
    w_y = combine(scale_y, rows[1], -scale_y * tangent_y, rows[2])
    return w_x, w_y


def build_tangent_limits(real: type) -> Scalar:
    """Builds (lowest x, highest x, lowest y, highest y) of the tangents for which the Jacobian is taken."""
    margin = real(TANGENT_MARGIN * 0.5)

    @inlined
    def tangent_limits(fx, fy, cx, cy, width, height):
        return (
            -(cx + margin * width) / fx,
            (width - cx + margin * width) / fx,
            -(cy + margin * height) / fy,
            (height - cy + margin * height) / fy,
        )

    return tangent_limits


def build_screen_covariance(real: type) -> Scalar:
    """Builds (xx, xy, yy, determinant), low-pass included, from the axes seen along w_x and w_y."""
    low_pass, low_pass_squared = real(LOW_PASS), real(LOW_PASS * LOW_PASS)

    @inlined
    def screen_covariance(v_x, v_y):
        xx, xy, yy = dot(v_x, v_x), dot(v_x, v_y), dot(v_y, v_y)
        # xx yy - xy^2 cancels for needles; Lagrange's identity gives the same as a sum of squares.
        determinant = cross_squared(v_x, v_y) + low_pass * (xx + yy) + low_pass_squared
        return xx + low_pass, xy, yy + low_pass, determinant

    return screen_covariance


def build_half_extents(real: type) -> Scalar:
    """Builds the distances from the centre along x and y, in pixels, at which the coverage drops to `ALPHA_MIN`.

    They are (0, 0) if it is never above.
    """
    zero, one, two, inverse_alpha_min = real(0.0), real(1.0), real(2.0), real(1.0 / ALPHA_MIN)

    @inlined
    def half_extents(xx, yy, opacity):
        visible = inverse_alpha_min * opacity
        if not visible > one:
            return zero, zero
        reach = two * math.log(visible)
        return math.sqrt(reach * xx), math.sqrt(reach * yy)

    return half_extents


def build_covariance_gradient(real: type) -> Scalar:
    """Builds gradients of the results of `screen_covariance`, from those (xx, xy, yy) of its inverse."""
    one, low_pass = real(1.0), real(LOW_PASS)

    @inlined
    def covariance_gradient(covariance, g_xx, g_xy, g_yy):
        # The inverse is (yy, -xy, xx) over the determinant. Products of two inverses would cancel for needles, and so
        # would the determinant if it were taken from the covariance.
        xx, xy, yy, determinant = covariance
        inverse = one / determinant
        g_determinant = -(g_xx * (yy * inverse) - g_xy * (xy * inverse) + g_yy * (xx * inverse)) * inverse
        by_trace = low_pass * g_determinant
        return g_yy * inverse + by_trace, -g_xy * inverse, g_xx * inverse + by_trace, g_determinant

    return covariance_gradient


@inlined
def footprint_gradient(w_x, w_y, v_x, v_y, axes, g_covariance):
    """Gradients of w_x and w_y, and of the three axes, from those of the results of `screen_covariance`."""
    g_xx, g_xy, g_yy, g_determinant = g_covariance
    normal = cross(v_x, v_y)
    gv_x = combine(ONE, combine(TWO * g_xx, v_x, g_xy, v_y), TWO * g_determinant, cross(v_y, normal))
    gv_y = combine(ONE, combine(g_xy, v_x, TWO * g_yy, v_y), TWO * g_determinant, cross(normal, v_x))
    gw_x = scaled_sum(gv_x, axes)
    gw_y = scaled_sum(gv_y, axes)
    g_axes = (
        combine(gv_x[0], w_x, gv_y[0], w_y),
        combine(gv_x[1], w_x, gv_y[1], w_y),
        combine(gv_x[2], w_x, gv_y[2], w_y),
    )
    return gw_x, gw_y, g_axes


# The region of the screen where a splat's coverage is at least `ALPHA_MIN`, an ellipse around its centre. In double
# precision throughout, because the determinant of a needle's conic is a small difference of large products.


@inlined
def half_height(xx, xy, yy, opacity):
    """Largest |dy| in the ellipse; negative if it is empty, infinite if the conic is degenerate."""
    xx, xy, yy, visible = np.float64(xx), np.float64(xy), np.float64(yy), np.float64(opacity) / ALPHA_MIN
    if not visible >= 1.0:
        return -1.0
    determinant = xx * yy - xy * xy
    if not (determinant > 0.0 and xx > 0.0):
        return np.inf
    # Compositing evaluates the quadratic form in single precision, where its terms cancel more for longer needles. The
    # bound is widened by that error, so that no pixel is lost to rounding.
    bound = 2.0 * math.log(visible) * (1.0 + 1e-6 * xx * yy / determinant) + 2e-3
    return math.sqrt(bound * xx / determinant)


@inlined
def outline(xx, xy, yy, height):
    """The ellipse in the form that `band` expects: (slope, widening, half height, dy of the rightmost point)."""
    xx, xy, yy = np.float64(xx), np.float64(xy), np.float64(yy)
    if not height < np.inf:
        return 0.0, np.inf, height, 0.0
    widening = math.sqrt(xx * yy - xy * xy) / xx
    # At the rightmost point dx = height sqrt(yy / xx), the form's derivative along y vanishes.
    return -xy / xx, widening, height, -xy / math.sqrt(xx * yy) * height


@inlined
def band(shape, low, high):
    """Smallest and largest dx of the ellipse over dy in [low, high], which must overlap it."""
    slope, widening, height, rightmost = shape
    if not height < np.inf:
        return -np.inf, np.inf
    at_right, at_left = min(max(rightmost, low), high), min(max(-rightmost, low), high)
    right = slope * at_right + widening * math.sqrt(max(height * height - at_right * at_right, 0.0))
    left = slope * at_left - widening * math.sqrt(max(height * height - at_left * at_left, 0.0))
    return left, right
