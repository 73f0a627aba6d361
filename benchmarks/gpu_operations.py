"""Times of each operation on a GPU, and both passes of compositing against measured peaks. Requires numba-cuda."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks.gpu_frames import HEIGHT, REPEATS, WIDTH, milliseconds, timed
from benchmarks.gpu_peaks import measured_peaks
from benchmarks.gpu_roofline import Peaks, backward_demand, counts_of, forward_demand
from benchmarks.kernels import backward, batch_of, raw_of, visited_pixels
from benchmarks.rays import operation_works
from benchmarks.scene import bench_camera, bench_scene
from benchmarks.table import Table
from benchmarks.timing import Work, interleaved_seconds
from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.composite import composite
from glassplat.kernels.photometric import photometric
from glassplat.kernels.project import project
from glassplat.kernels.records import Splats, TileBins
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.frame import concat_splats

RAYS_WIDTH = 1024
"""Width of the square image of a mirror ball that reflects the rays, in pixels."""

Bound = Callable[[Peaks], float]


def kernel_times(count: int) -> Table:
    """Milliseconds of each operation, forward and backward."""
    camera = bench_camera(WIDTH, HEIGHT)
    scene = bench_scene(count, 0, 0.0, camera).to("cuda")
    raw, batch = raw_of(scene.primary, trainable=True), batch_of(camera.to("cuda"))
    projected = project(raw, batch, sh_degree=3, near=0.03)
    splats = concat_splats(type(projected)(*(tensor.detach() for tensor in projected)))
    bins = bin_tiles(splats, WIDTH, HEIGHT)
    leaves: Any = [tensor.clone().requires_grad_() for tensor in (*splats[:3], projected.colors.detach())]
    blended = composite(splats._replace(means2d=leaves[0], conics=leaves[1], opacities=leaves[2]), leaves[3], bins)
    picture = torch.rand(HEIGHT, WIDTH, 3, device="cuda")
    photo = (torch.rand(HEIGHT, WIDTH, 3, device="cuda") * 255).to(torch.uint8)
    image = picture.clone().requires_grad_()
    means = list(photometric(image, photo))
    weights = [torch.rand_like(tensor) for tensor in projected[:5]]
    works: dict[str, Work] = {
        "project forward": lambda: project(raw, batch, sh_degree=3, near=0.03),
        "project backward": backward(list(projected[:5]), weights, list(raw)),
        "bin_tiles": lambda: bin_tiles(splats, WIDTH, HEIGHT),
        "composite forward": lambda: composite(splats, leaves[3].detach(), bins),
        "composite backward": backward([blended.image], [picture[None]], leaves),
        "photometric forward": lambda: photometric(picture, photo),
        "photometric backward": backward(means, [torch.ones_like(means[0])] * 2, [image]),
    } | operation_works(count, RAYS_WIDTH, "cuda")
    evaluations = visited_pixels(type(splats)(*(t.cpu() for t in splats)), bins_on_cpu(bins))
    seconds = interleaved_seconds({name: timed(work) for name, work in works.items()}, REPEATS)
    peaks, least = measured_peaks(), least_seconds(splats, leaves[3].detach(), bins, evaluations)
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


def bins_on_cpu(bins: Any) -> Any:
    """The same bins on the CPU."""
    return type(bins)(*(field.cpu() if isinstance(field, Tensor) else field for field in bins))
