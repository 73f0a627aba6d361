"""Throughput of the kernels, compared with the multiply-add peak of the machine and with their PyTorch twins."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.methods import thread_count
from benchmarks.peak import peak_multiply_adds
from benchmarks.scene import bench_camera, room
from benchmarks.table import Table
from benchmarks.timing import Work, interleaved_seconds, median_seconds, paired_ratio
from glassplat.kernels import tiles as bin_tiles_module
from glassplat.kernels.composite import composite
from glassplat.kernels.composite import reference as composite_twin
from glassplat.kernels.composite.cpu import composite as blend_on_cpu
from glassplat.kernels.composite.cpu_tile import BLOCKS, LANES
from glassplat.kernels.photometric import photometric
from glassplat.kernels.photometric import reference as photometric_twin
from glassplat.kernels.project import project
from glassplat.kernels.project import reference as project_twin
from glassplat.kernels.records import CameraBatch, Projected, RawGaussians, Splats, TileBins
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.frame import concat_splats
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians

WIDTH, HEIGHT, COUNT = 480, 352, 100_000
MULTIPLY_ADDS = 18
"""Multiply-adds of one pixel-Gaussian evaluation with three channels: offsets and quadratic form 5, exponential 7,
alpha and transmittance 3, colour 3."""


def raw_of(gaussians: Gaussians, trainable: bool = False) -> RawGaussians:
    """Arguments of `project`."""
    g = gaussians
    tensors = (g.means, g.quats, g.log_scales, g.logit_opacities, g.sh)
    return RawGaussians(*(t.clone().requires_grad_() if trainable else t for t in tensors))


def batch_of(camera: Camera) -> CameraBatch:
    """One camera as a batch."""
    return CameraBatch(camera.cam_from_world[None], camera.intrinsics[None], camera.width, camera.height, None)


def visited_pixels(splats: Splats, bins: TileBins) -> int:
    """Pixel-Gaussian evaluations of a full traversal: for each (tile, splat) pair, 16 pixels in each row it reaches."""
    tile_of_pair = torch.repeat_interleave(torch.arange(len(bins.tile_offsets) - 1), bins.tile_offsets.diff())
    columns = -(-bins.width // bin_tiles_module.TILE)
    top = (tile_of_pair // columns * bin_tiles_module.TILE).float()
    pair = bins.pair_splats.long()
    center, reach = splats.means2d[0, :, 1][pair], splats.radii[0, :, 1][pair]
    first = torch.maximum(torch.ceil(center - reach - 0.5), top)
    last = torch.minimum(torch.floor(center + reach - 0.5), top + bin_tiles_module.TILE - 1)
    return int((last - first + 1).clamp(min=0).sum()) * bin_tiles_module.TILE


def evaluated_pixels(splats: Splats, channels: Tensor, bins: TileBins) -> int:
    """Pixel-Gaussian evaluations of the CPU kernel: for each (tile, splat) pair, the pixels of blocks it reaches."""
    marks, count = channels.new_zeros(channels.shape[0], 0), channels.shape[1]
    *_, saved = blend_on_cpu(
        splats, channels, bins, marks=marks, num_primary=count, deviation=None, needs_gradients=False
    )
    blocks = saved.pairs & ((1 << BLOCKS) - 1)
    return LANES * int(np.unpackbits(blocks.numpy().view(np.uint8)).sum())


def kernel_works(gaussians: Gaussians, camera: Camera) -> tuple[dict[str, Work], Splats, Tensor, TileBins]:
    """Both passes of the kernels, on the device of the Gaussians; and splats, colours and tile bins to composite."""
    raw, batch = raw_of(gaussians, trainable=True), batch_of(camera)
    projected = project(raw, batch, sh_degree=3, near=0.03)
    flat = Projected(*(t.detach() for t in projected))
    splats = concat_splats(flat)
    bins = bin_tiles(splats, camera.width, camera.height)
    leaves: list[Any] = [t.clone().requires_grad_() for t in (*splats[:3], flat.colors)]
    blended = composite(splats._replace(means2d=leaves[0], conics=leaves[1], opacities=leaves[2]), leaves[3], bins)
    picture = torch.rand(camera.height, camera.width, 3, device=gaussians.means.device)
    photo = (torch.rand_like(picture) * 255).to(torch.uint8)
    image = picture.clone().requires_grad_()
    means = list(photometric(image, photo))
    weights = [torch.rand_like(t) for t in projected[:5]]
    works: dict[str, Work] = {
        "project forward": lambda: project(raw_of(gaussians), batch, sh_degree=3, near=0.03),
        "project backward": backward(list(projected[:5]), weights, list(raw)),
        "bin_tiles": lambda: bin_tiles(splats, camera.width, camera.height),
        "composite forward": lambda: composite(splats, flat.colors, bins),
        "composite backward": backward([blended.image], [picture[None]], leaves),
        "photometric forward": lambda: photometric(picture, photo),
        "photometric forward, for a gradient": lambda: photometric(image, photo),
        "photometric backward": backward(means, [torch.ones_like(means[0])] * 2, [image]),
    }
    return works, splats, flat.colors, bins


def kernel_times() -> Table:
    """Milliseconds of every kernel at 100k Gaussians."""
    works, splats, colors, bins = kernel_works(room(COUNT), bench_camera(WIDTH, HEIGHT))
    evaluations = evaluated_pixels(splats, colors, bins)
    peak = peak_multiply_adds(2)
    table = Table(
        f"Kernels, {COUNT // 1000}k Gaussians (half of them in front of the camera), SH 3, {WIDTH}x{HEIGHT}",
        ("kernel", "1 thread, ms", "2 threads, ms", "evaluations/s, 2 threads", "share of peak"),
        f"{len(bins.pair_splats):,} (tile, splat) pairs, {evaluations:,} pixel-Gaussian evaluations. The peak is "
        f"measured: {peak / 1e9:.0f} G multiply-adds/s on two threads; an evaluation counts {MULTIPLY_ADDS} forward "
        "and twice that backward.",
    )
    for name, work in works.items():
        one, two = at_threads(work, 1), at_threads(work, 2)
        if name.startswith("composite"):
            rate = evaluations / two
            share = rate * MULTIPLY_ADDS * (2 if name.endswith("backward") else 1) / peak
            table.add(name, 1e3 * one, 1e3 * two, f"{rate / 1e9:.2f} G", f"{100 * share:.0f} %")
        else:
            table.add(name, 1e3 * one, 1e3 * two, "", "")
    return table


def backward(outputs: list[Tensor], weights: list[Tensor], inputs: list[Any]) -> Work:
    """A repeatable backward pass."""
    return lambda: torch.autograd.grad(outputs, inputs, weights, retain_graph=True)


def at_threads(work: Work, threads: int) -> float:
    """Median seconds on the given number of threads."""
    with thread_count(threads):
        return median_seconds(work)


def twin_ratios() -> Table:
    """Speed of the kernels relative to their twins, at sizes that the twins can handle."""
    camera = bench_camera(64, 48)
    gaussians = room(1000)
    raw, batch = raw_of(gaussians), batch_of(camera)
    flat = project(raw, batch, sh_degree=3, near=0.03)
    splats = concat_splats(flat)
    bins = bin_tiles(splats, 64, 48)
    picture, photo = torch.rand(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    large = raw_of(room(COUNT))
    full = batch_of(bench_camera(WIDTH, HEIGHT))
    pairs: dict[str, tuple[Work, Work]] = {
        "project, 100k Gaussians": (
            lambda: project(large, full, sh_degree=3, near=0.03),
            lambda: project_twin.project(large, full, sh_degree=3, near=0.03),
        ),
        "composite, 1k Gaussians, 64x48": (
            lambda: composite(splats, flat.colors, bins),
            lambda: composite_twin.composite(splats, flat.colors, bins),
        ),
        f"photometric, {WIDTH}x{HEIGHT}": (
            lambda: photometric(picture, photo),
            lambda: photometric_twin.photometric(picture, photo),
        ),
    }
    table = Table(
        "Kernels against their PyTorch twins, forward", ("operation", "kernel, ms", "twin, ms", "twin : kernel")
    )
    for name, (kernel, twin) in pairs.items():
        seconds = interleaved_seconds({"kernel": kernel, "twin": twin}, repeats=5)
        medians = [1e3 * sorted(seconds[n])[2] for n in ("kernel", "twin")]
        table.add(name, *medians, paired_ratio(seconds, "twin", "kernel"))
    return table
