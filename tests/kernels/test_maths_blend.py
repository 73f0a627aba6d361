from __future__ import annotations

import math

import numpy as np
import pytest

from glassplat.kernels.maths.blending import ALPHA_MIN, build_exp2, build_row_range, build_vertical_reach


@pytest.mark.parametrize(("real", "tolerance"), [(np.float32, 4e-7), (np.float64, 1e-15)])
def test_exp2_is_accurate_where_coverage_counts(real: type, tolerance: float) -> None:
    exp2 = build_exp2(real)
    for t in np.linspace(-20, 0, 401):
        assert float(exp2(real(t))) == pytest.approx(2.0 ** float(real(t)), rel=tolerance)
    assert exp2(real(0)) == 1


@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize("t", [-100.0, -1e30, -math.inf, math.nan])
def test_exp2_underflows_to_zero(real: type, t: float) -> None:
    assert 0 <= float(build_exp2(real)(real(t))) < 1e-20


@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize(("xx", "xy", "yy"), [(0.5, 0.0, 0.5), (0.4, 0.19, 0.1), (2.0, -0.3, 0.06), (1.0, 0.9999, 1.0)])
def test_rows_in_range_are_those_with_coverage(real: type, xx: float, xy: float, yy: float) -> None:
    opacity = real(0.7)
    reach = build_vertical_reach(real)(real(xx), real(xy), real(yy), opacity)
    for center in (-3.2, 0.5, 7.9, 30.0):
        first, last = build_row_range(real)(real(center), reach, 16)
        assert 0 <= first <= last <= 16
        # The coverage in a row is largest where the quadratic form is smallest over x.
        least = (yy - xy * xy / xx) * (np.arange(16) + 0.5 - center) ** 2
        covered = np.flatnonzero(opacity * np.exp(-0.5 * least) >= ALPHA_MIN)
        assert list(range(first, last)) == list(covered), center


@pytest.mark.parametrize("broken", [0, 1, 2, 3])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_broken_splats_cover_no_tile(broken: int, value: float) -> None:
    vertical_reach, row_range = build_vertical_reach(np.float32), build_row_range(np.float32)
    inputs = [np.float32(v) for v in (0.5, 0.1, 0.5, 0.7)]
    inputs[broken] = np.float32(value)
    with np.errstate(invalid="ignore"):
        first, last = row_range(np.float32(8), vertical_reach(*inputs), 16)
    assert first == last or (value == math.inf and broken in (0, 2))


def test_a_splat_without_a_position_covers_no_tile() -> None:
    row_range = build_row_range(np.float32)
    for center in (math.nan, math.inf, -math.inf):
        first, last = row_range(np.float32(center), np.float32(5), 16)
        assert first == last
