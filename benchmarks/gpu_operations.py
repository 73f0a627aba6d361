"""Times of each operation on a GPU, and both passes of compositing against measured peaks. Requires numba-cuda."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

from torch import Tensor

from benchmarks.gpu_frames import HEIGHT, REPEATS, WIDTH, milliseconds, timed
from benchmarks.gpu_peaks import measured_peaks
from benchmarks.gpu_roofline import Peaks, backward_demand, counts_of, forward_demand
from benchmarks.kernels import kernel_works, visited_pixels
from benchmarks.rays import operation_works
from benchmarks.scene import bench_camera, room
from benchmarks.table import Table
from benchmarks.timing import interleaved_seconds
from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.records import Splats, TileBins

RAYS_WIDTH = 1024
"""Width of the square image of a mirror ball that reflects the rays, in pixels."""

Bound = Callable[[Peaks], float]


def kernel_times(count: int) -> Table:
    """Milliseconds of each operation, forward and backward."""
    works, splats, colors, bins = kernel_works(room(count).to("cuda"), bench_camera(WIDTH, HEIGHT).to("cuda"))
    works |= operation_works(count, RAYS_WIDTH, "cuda")
    on_cpu: Any = [type(part)(*(x.cpu() if isinstance(x, Tensor) else x for x in part)) for part in (splats, bins)]
    evaluations = visited_pixels(*on_cpu)
    seconds = interleaved_seconds({name: timed(work) for name, work in works.items()}, REPEATS)
    peaks, least = measured_peaks(), least_seconds(splats, colors, bins, evaluations)
    table = Table(
        "Operations", ("operation", "ms", "ms at the peaks", "share of the roofline"),
        f"{len(bins.pair_splats):,} (tile, splat) pairs, {evaluations:,} pixel-Gaussian evaluations if none stopped. "
        f"Measured peaks: {peaks.multiply_adds / 1e12:.1f} T multiply-adds/s, {peaks.bytes / 1e9:.0f} GB/s.",
    )  # fmt: skip
    for name in works:
        bound = least[name](peaks) if name in least else None
        shown = ("", "") if bound is None else (1e3 * bound, f"{bound / statistics.median(seconds[name]):.0%}")
        table.add(name, milliseconds(seconds, name), *shown)
    return table


def least_seconds(splats: Splats, channels: Tensor, bins: TileBins, evaluations: int) -> dict[str, Bound]:
    """Lower bounds in seconds for both passes of `composite`, from the counts of a forward pass."""
    forward = kernels_for("composite", channels.device).composite
    marks, count = channels.new_zeros(1, 0), channels.shape[1]
    options: dict[str, Any] = {"marks": marks, "num_primary": count, "deviation": None, "needs_gradients": True}
    saved = forward(splats, channels, bins, **options)[-1]
    counts = counts_of(saved, evaluations, len(bins.pair_splats), channels.shape[2])
    return {
        "composite forward": forward_demand(counts._replace(buckets=0)).seconds_at,
        "composite backward": backward_demand(counts).seconds_at,
    }
