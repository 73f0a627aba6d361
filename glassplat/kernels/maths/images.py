"""Maths of images: conversion between sRGB and linear radiance, and the sums of SSIM."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths.blending import Scalar

THRESHOLD_SRGB, THRESHOLD_LINEAR = 0.04045, 0.0031308
GAMMA, OFFSET, SLOPE = 2.4, 0.055, 12.92

# log2(m) = 2 / ln 2 (s + s^3 / 3 + ...), s = (m - 1) / (m + 1), |s| <= 0.172 for m in [sqrt(1/2), sqrt(2)).
_LOG2 = tuple(2 / math.log(2.0) / k for k in (1, 3, 5, 7, 9))
# Taylor series of 2^f for f in [-1/2, 1/2].
_EXP2 = tuple(math.log(2.0) ** k / math.factorial(k) for k in range(8))


def color_space_maths(real: type) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Builds the scalar functions of colour `linear`, `linear_derivative`, `encoded` and `encoded_derivative`.

    `linear` is the linear radiance of an sRGB value (IEC 61966-2-1), continued beyond 1, and linearly below 0. Its
    derivative is given the sRGB value and its linear radiance. `encoded`, the inverse of `linear`, is the sRGB value of
    a linear radiance. Its derivative is given the radiance and its sRGB value.
    """
    power = _fast_power() if real is np.float32 else _exact_power
    low, low_linear = real(THRESHOLD_SRGB), real(THRESHOLD_LINEAR)
    offset, inverse_scale, scale = real(OFFSET), real(1 / (1 + OFFSET)), real(1 + OFFSET)
    gamma, inverse_gamma, slope, inverse_slope = real(GAMMA), real(1 / GAMMA), real(SLOPE), real(1 / SLOPE)

    @inlined
    def linear(color):
        curved = power(((color if color > low else low) + offset) * inverse_scale, gamma)
        return curved if color > low else color * inverse_slope

    @inlined
    def linear_derivative(color, radiance):
        return gamma * radiance / ((color if color > low else low) + offset) if color > low else inverse_slope

    @inlined
    def encoded(radiance):
        curved = scale * power(radiance if radiance > low_linear else low_linear, inverse_gamma) - offset
        return curved if radiance > low_linear else slope * radiance

    @inlined
    def encoded_derivative(radiance, color):
        safe = radiance if radiance > low_linear else low_linear
        return inverse_gamma * (color + offset) / safe if radiance > low_linear else slope

    return linear, linear_derivative, encoded, encoded_derivative


def _fast_power() -> Scalar:
    real = np.float32
    l1, l3, l5, l7, l9 = (real(c) for c in _LOG2)
    e0, e1, e2, e3, e4, e5, e6, e7 = (real(c) for c in _EXP2)
    one, half, lowest, highest = real(1.0), real(0.5), real(-126.0), real(126.0)
    root_half_bits = np.float32(math.sqrt(0.5)).view(np.int32)
    mantissa_bits, bias = np.int32(23), np.int32(127)

    @inlined
    def power(base, exponent):
        """base^exponent of normal positive floats, relative error below 1e-6 while the result is within 2^+-8."""
        bits = np.float32(base).view(np.int32)
        whole = np.int32((bits - root_half_bits) >> mantissa_bits)
        mantissa = np.int32(bits - np.int32(whole << mantissa_bits)).view(np.float32)
        s = (mantissa - one) / (mantissa + one)
        s2 = s * s
        log2 = real(whole) + s * ((((l9 * s2 + l7) * s2 + l5) * s2 + l3) * s2 + l1)
        t = exponent * log2
        t = t if t > lowest else lowest
        t = t if t < highest else highest
        nearest = np.int32(t + (half if t > real(0.0) else -half))
        f = t - real(nearest)
        fraction = ((((((e7 * f + e6) * f + e5) * f + e4) * f + e3) * f + e2) * f + e1) * f + e0
        return fraction * np.int32((nearest + bias) << mantissa_bits).view(np.float32)

    return power


@inlined
def _exact_power(base, exponent):
    return base**exponent


def linear_from_srgb(color: Tensor) -> Tensor:
    """Linear radiance of sRGB values (IEC 61966-2-1); continued beyond 1, and linearly below 0."""
    curved = ((color.clamp(min=THRESHOLD_SRGB) + OFFSET) / (1 + OFFSET)) ** GAMMA
    return torch.where(color > THRESHOLD_SRGB, curved, color / SLOPE)


def srgb_from_linear(radiance: Tensor) -> Tensor:
    """sRGB values of linear radiance, the inverse of `linear_from_srgb`."""
    curved = (1 + OFFSET) * radiance.clamp(min=THRESHOLD_LINEAR) ** (1 / GAMMA) - OFFSET
    return torch.where(radiance > THRESHOLD_LINEAR, curved, SLOPE * radiance)


RADIUS = 5
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


def window() -> list[float]:
    """The 11 weights of the Gaussian window; they sum to one."""
    weights = [math.exp(-0.5 * (offset / SIGMA) ** 2) for offset in range(-RADIUS, RADIUS + 1)]
    return [weight / sum(weights) for weight in weights]


def build_blur(real: type) -> Scalar:
    """Builds the weighted sum of 11 values of an array, `step` apart, the first of them at `at`."""
    w0, w1, w2, w3, w4, w5 = (real(weight) for weight in window()[: RADIUS + 1])

    @inlined
    def blur(values, at, step):
        outer = w0 * (values[at] + values[at + 10 * step]) + w1 * (values[at + step] + values[at + 9 * step])
        middle = w2 * (values[at + 2 * step] + values[at + 8 * step]) + w3 * (
            values[at + 3 * step] + values[at + 7 * step]
        )
        return outer + middle + w4 * (values[at + 4 * step] + values[at + 6 * step]) + w5 * values[at + 5 * step]

    return blur


def build_compare(real: type) -> Scalar:
    """Builds the similarity of two pixels a and b (Wang et al. 2004, Eq. 13), and three derivatives.

    These are with respect to the blurred a, the blurred sum of squares a^2 + b^2 and the blurred product a b, from
    these and the blurred b.
    """
    one, two, c1, c2 = real(1.0), real(2.0), real(C1), real(C2)

    @inlined
    def compare(mean_a, mean_b, squares, product):
        means, mean_squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
        a1, a2 = two * means + c1, two * (product - means) + c2
        b1, b2 = one / (mean_squares + c1), one / (squares - mean_squares + c2)
        value = a1 * a2 * b1 * b2
        by_mean = two * (mean_b * (a2 - a1) * b1 * b2 + mean_a * value * (b2 - b1))
        return value, by_mean, -value * b2, two * a1 * b1 * b2

    return compare
