"""Least times of the compositing kernels at a GPU's peaks, from counted multiply-adds and bytes."""

from __future__ import annotations

from typing import Any, NamedTuple

from benchmarks.kernels import MULTIPLY_ADDS
from glassplat.kernels.composite.cuda_tile import BUCKET, PIXELS

GEOMETRY_BYTES = 28
"""Of one pair: the splat's index, mean, conic and opacity."""
MOMENTS = 6


class Peaks(NamedTuple):
    """Multiply-adds and bytes of memory per second."""

    multiply_adds: float
    bytes: float


class Counts(NamedTuple):
    """Counts of a traversal of all tiles.

    pairs: (tile, splat) pairs that any pixel looked at. evaluations: of a splat at a pixel. buckets: that were stored.
    pixels: of the image. channels: of a splat.
    """

    pairs: int
    evaluations: int
    buckets: int
    pixels: int
    channels: int


class Demand(NamedTuple):
    """Multiply-adds and bytes of one run of a kernel."""

    multiply_adds: float
    bytes: float

    def seconds_at(self, peaks: Peaks) -> float:
        """The least time: either the arithmetic or the memory is the bound."""
        return max(self.multiply_adds / peaks.multiply_adds, self.bytes / peaks.bytes)


def forward_demand(counts: Counts) -> Demand:
    """Of the forward pass with what the backward pass needs: splats are read once per tile, state is written once."""
    splats = counts.pairs * (GEOMETRY_BYTES + 4 * counts.channels)
    kept = counts.buckets * PIXELS * 4 * (counts.channels + 1)
    return Demand(counts.evaluations * MULTIPLY_ADDS, splats + kept + counts.pixels * 4 * (counts.channels + 6))


def backward_demand(counts: Counts) -> Demand:
    """Of the backward pass: as the forward pass, and one gradient row for each pair; twice the arithmetic."""
    forward = forward_demand(counts)
    rows = counts.pairs * 4 * (MOMENTS + counts.channels)
    return Demand(2 * forward.multiply_adds, forward.bytes + rows)


def counts_of(saved: Any, visited: int, pairs: int, channels: int) -> Counts:
    """Counts from what the forward pass saved.

    Args:
        saved: `glassplat.kernels.composite.cuda.Saved`.
        visited: evaluations of a traversal in which no pixel stops early.
        pairs: all (tile, splat) pairs.
        channels: of a splat.
    """
    last = saved.last[:, 0]
    share = float((last.double() + 1).sum()) / max(pairs * PIXELS, 1)
    looked_at = int(saved.looked_at.sum())
    buckets = int((-(-saved.looked_at // BUCKET)).sum())
    return Counts(looked_at, int(visited * share), buckets, last.numel(), channels)
