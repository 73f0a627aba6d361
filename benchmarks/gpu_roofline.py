"""Lower bounds for the times of the compositing kernels at the peaks of a GPU, from counted multiply-adds and bytes."""

from __future__ import annotations

from typing import Any, NamedTuple

from benchmarks.kernels import MULTIPLY_ADDS
from glassplat.kernels.composite.cuda_tile import BUCKET, PIXELS

GEOMETRY_BYTES = 28
"""Bytes read per pair: index, mean, conic and opacity of the splat."""
MOMENTS = 6


class Peaks(NamedTuple):
    """Multiply-adds and bytes of memory per second."""

    multiply_adds: float
    bytes: float


class Counts(NamedTuple):
    """Counts of a traversal of all tiles.

    pairs: (tile, splat) pairs visited by any pixel. evaluations: evaluations of a splat at a pixel. buckets: stored
        buckets. pixels: pixels of the image. channels: channels per splat.
    """

    pairs: int
    evaluations: int
    buckets: int
    pixels: int
    channels: int


class Demand(NamedTuple):
    """Multiply-adds and bytes of one launch of a kernel."""

    multiply_adds: float
    bytes: float

    def seconds_at(self, peaks: Peaks) -> float:
        """Lower bound of the time, limited by arithmetic or by memory."""
        return max(self.multiply_adds / peaks.multiply_adds, self.bytes / peaks.bytes)


def forward_demand(counts: Counts) -> Demand:
    """Demand of the forward pass in training: splats are read once per tile, and the saved state is written once."""
    splats = counts.pairs * (GEOMETRY_BYTES + 4 * counts.channels)
    kept = counts.buckets * PIXELS * 4 * (counts.channels + 1)
    return Demand(counts.evaluations * MULTIPLY_ADDS, splats + kept + counts.pixels * 4 * (counts.channels + 6))


def backward_demand(counts: Counts) -> Demand:
    """Demand of the backward pass: twice the arithmetic of the forward pass, and one more gradient row per pair."""
    forward = forward_demand(counts)
    rows = counts.pairs * 4 * (MOMENTS + counts.channels)
    return Demand(2 * forward.multiply_adds, forward.bytes + rows)


def counts_of(saved: Any, visited: int, pairs: int, channels: int) -> Counts:
    """Counts from the state saved by the forward pass.

    Args:
        saved: `glassplat.kernels.composite.cuda.Saved`.
        visited: evaluations in a traversal without early stopping.
        pairs: number of (tile, splat) pairs.
        channels: channels per splat.
    """
    last = saved.last[:, 0]
    share = float((last.double() + 1).sum()) / max(pairs * PIXELS, 1)
    looked_at = int(saved.looked_at.sum())
    buckets = int((-(-saved.looked_at // BUCKET)).sum())
    return Counts(looked_at, int(visited * share), buckets, last.numel(), channels)
