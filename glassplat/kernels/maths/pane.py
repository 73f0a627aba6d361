"""Scalar maths of a flat pane: its reflectance, and the blending of transmission and reflection.

Rays are (x, y, 1) in the camera frame. Every function is pure and, where needed, typed by its factory, so that one
source compiles for the CPU and for CUDA.
"""

from __future__ import annotations

import math
from typing import get_args

import numpy as np

from glassplat.kernels import Fresnel
from glassplat.kernels.backend.cpu import ONE, TWO, ZERO, inlined
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.images import color_space_maths

LAWS: tuple[Fresnel, ...] = get_args(Fresnel)
"""Kernels receive a law as its index in this tuple."""
PANE, SCHLICK = LAWS.index("pane"), LAWS.index("schlick")

LEAST_COSINE = 1e-6
"""Lower bound of the cosine for two surfaces: below it, a pane that reflects nothing would divide 0 by 0."""

DARKEST = 0.05
"""sRGB value above which the derivative of linear light is treated as proportional to it, as for a gamma of 2."""
FULL_WEIGHT_RATIO = 2.0
"""Largest ratio s of `kernels.panes.gradient_conflict` with full weight; the weight falls to 0 at twice the ratio.
Both types share it, so it must be exact in single precision."""


def pane_maths(real: type) -> tuple[Scalar, Scalar, Scalar]:
    """Builds `strength`, `strength_derivatives` and `ray_length`.

    These are the reflectance by a law, given the reflectance R0 at normal incidence and the cosine of the angle; its
    derivatives by R0 and by the cosine; and the length of the ray (x, y, 1).
    """
    schlick, schlick_derivatives = _schlick(real)
    two_surfaces, two_surfaces_derivatives = _two_surfaces(real)
    zero, one = real(0.0), real(1.0)

    @inlined
    def strength(law, base, cosine):
        if law == PANE:
            return two_surfaces(base, cosine)
        if law == SCHLICK:
            return schlick(base, cosine)
        return base

    @inlined
    def strength_derivatives(law, base, cosine):
        if law == PANE:
            return two_surfaces_derivatives(base, cosine)
        if law == SCHLICK:
            return schlick_derivatives(base, cosine)
        return one, zero

    @inlined
    def ray_length(x, y):
        return real(math.sqrt(x * x + y * y + one))

    return strength, strength_derivatives, ray_length


@inlined
def weighted_edges(edges, held, full, has_strength):
    """A cell's contribution to the sum of shared edges, and its derivative by the edges; the weight is constant.

    `kernels.panes.gradient_conflict` explains the weight.
    """
    weight = ONE
    if has_strength and held != ZERO:
        weight = min(max(TWO - abs(held) / (np.float32(FULL_WEIGHT_RATIO) * full), ZERO), ONE)
    slope = weight if edges > ZERO else -weight
    return weight * abs(edges), slope if edges != ZERO else ZERO


def build_blend_channel(real: type) -> tuple[Scalar, Scalar]:
    """Builds the blending of one sRGB channel of a pixel with the pane's reflection, and its adjoint.

    `share` is the pane's reflectance and `gain` the intensity of the reflection; `linear` blends linear light instead
    of sRGB values.
    """
    linear_of, linear_derivative, encoded, encoded_derivative = color_space_maths(real)
    one = real(1.0)

    @inlined
    def blend_channel(behind, mirrored, gain, share, linear):
        """The blended channel, and the reflection times its intensity."""
        if linear:
            lit, bright = linear_of(behind), linear_of(mirrored) * gain
            return encoded(lit + share * (bright - lit)), encoded(bright)
        bright = mirrored * gain
        return behind + share * (bright - behind), bright

    @inlined
    def blend_channel_gradient(behind, mirrored, gain, share, linear, v_mixed, v_bright):
        """Gradients of the first four arguments, given those of the results of `blend_channel`."""
        if linear:
            lit, shone = linear_of(behind), linear_of(mirrored)
            bright = shone * gain
            mixed = lit + share * (bright - lit)
            v_mixed *= encoded_derivative(mixed, encoded(mixed))
            v_bright = v_mixed * share + v_bright * encoded_derivative(bright, encoded(bright))
            v_behind = v_mixed * (one - share) * linear_derivative(behind, lit)
            v_mirrored = v_bright * gain * linear_derivative(mirrored, shone)
            return v_behind, v_mirrored, v_bright * shone, v_mixed * (bright - lit)
        v_bright += v_mixed * share
        return v_mixed * (one - share), v_bright * gain, v_bright * mirrored, v_mixed * (mirrored * gain - behind)

    return blend_channel, blend_channel_gradient


def _schlick(real: type) -> tuple[Scalar, Scalar]:
    """R0 + (1 - R0) (1 - c)^5 (TR-Gaussians, Eq. 6), and its derivatives."""
    zero, one, five = real(0.0), real(1.0), real(5.0)

    @inlined
    def schlick(base, cosine):
        grazing = one - (cosine if cosine < one else one)
        squared = grazing * grazing
        return base + (one - base) * squared * squared * grazing

    @inlined
    def schlick_derivatives(base, cosine):
        grazing = one - (cosine if cosine < one else one)
        squared = grazing * grazing
        fourth = squared * squared
        return one - fourth * grazing, -five * (one - base) * fourth if cosine < one else zero

    return schlick, schlick_derivatives


def _two_surfaces(real: type) -> tuple[Scalar, Scalar]:
    """Fresnel reflectance of a pane's two surfaces, including multiple reflections between them, and its derivatives.

    A surface of relative index n refracts the cosine c to c_t. With q = 1 / n^2, one polarisation's Fresnel coefficient
    is (a - b) / (a + b) for (a, b) = (c_t, c / n), the other's for (c, c_t / n), and two surfaces reflect 2 r / (1 + r)
    = (a - b)^2 / (a^2 + b^2). With t = 1 - R0 and w = sqrt(1 - t^2) = (1 - q) / (1 + q), everything below is rational
    in t, w, c and c_t. a - b is (a^2 - b^2) / (a + b), whose numerator has no difference of nearly equal numbers left.
    Values and derivatives are therefore accurate for any pane, from one that reflects nothing to a perfect mirror.
    """
    zero, half, one, least = real(0.0), real(0.5), real(1.0), real(LEAST_COSINE)

    @inlined
    def terms(base, cosine):
        """Multiples of a^2 + b^2 for both polarisations; then w, 1 - w, c_t, and the clamped cosine."""
        cosine = cosine if cosine > least else least
        cosine = cosine if cosine < one else one
        through = one - base
        w = real(math.sqrt(base * (one + through)))
        rest = through * through / (one + w)
        squared = cosine * cosine
        inside = real(math.sqrt((w + w + rest * squared) / (one + w)))
        across, along = w + rest * squared, (one + w * w) * squared + w * rest
        return across, along, w, rest, inside, cosine

    @inlined
    def two_surfaces(base, cosine):
        across, along, w, rest, inside, c = terms(base, cosine)
        # Scaled in the same way: 2 a b, and the second a^2 - b^2, which is 0 at Brewster's angle; the first is w.
        product, difference = (one - base) * c * inside, w * (c * c + c * c - rest)
        first = w * w / (across * (across + product))
        return half * (first + difference * difference / (along * (along + product * (one + w))))

    @inlined
    def two_surfaces_derivatives(base, cosine):
        across, along, w, rest, inside, c = terms(base, cosine)
        inverse_across, inverse_along, inverse_inside = one / across, one / along, one / inside
        first, second = inverse_across * inverse_across, inverse_along * inverse_along
        doubled = c * c + c * c
        second *= doubled - rest
        by_base = half * c * inverse_inside * (first + second * (w + w + rest * (doubled - one)))
        by_cosine = (one - base) * w * w * inverse_inside * (second - first / (one + w))
        return by_base, by_cosine if (cosine > least) & (cosine < one) else zero

    return two_surfaces, two_surfaces_derivatives
