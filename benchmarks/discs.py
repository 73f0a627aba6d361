"""`python -m benchmarks.discs`: cost of discs compared with ellipsoids of the same positions and two of their sizes.

CPU time, the minimum over several rounds in which both alternate, so that other programs hardly matter.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.kernels import HEIGHT, WIDTH
from benchmarks.scene import bench_camera, room
from benchmarks.table import Table
from benchmarks.timing import Work, interleaved_seconds
from glassplat.kernels.composite import composite
from glassplat.kernels.records import Splats
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.frame import concat_splats, project_gaussians
from glassplat.render.splat import blend_discs, projected_discs
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians

COUNT, ROUNDS, NEAR = 100_000, 7, 0.03


class Primitive(NamedTuple):
    """Steps for one kind of Gaussians, and the number of their (tile, splat) pairs."""

    works: dict[str, Work]
    pairs: int


def learning(gaussians: Gaussians) -> Gaussians:
    """The same set as leaf tensors that require gradients."""
    return gaussians.with_tensors({name: t.clone().requires_grad_() for name, t in gaussians.tensors().items()})


def backward(outputs: Sequence[Tensor], gaussians: Gaussians) -> Work:
    """A repeatable backward pass to all tensors."""
    smooth = [output for output in outputs if output.requires_grad]
    weights = [torch.rand_like(output) for output in smooth]
    inputs = list(gaussians.tensors().values())
    return lambda: torch.autograd.grad(smooth, inputs, weights, retain_graph=True, allow_unused=True)


def ellipsoids(gaussians: Gaussians, camera: Camera) -> Primitive:
    """Projection, tile binning and blending of ellipsoids with colour and depth."""
    own = learning(gaussians)
    projected = project_gaussians(own, camera, near=NEAR)
    splats = Splats(*(t.detach() for t in concat_splats(projected)))
    bins = bin_tiles(splats, camera.width, camera.height)
    channels = torch.cat([projected.colors, projected.depths[..., None]], dim=-1)
    blended = composite(concat_splats(projected), channels, bins)
    works: dict[str, Work] = {
        "project forward": lambda: project_gaussians(gaussians, camera, near=NEAR),
        "project backward": backward(projected, own),
        "tiles and blending forward": lambda: composite(
            splats, channels.detach(), bin_tiles(splats, camera.width, camera.height)
        ),
        "all backward": backward(blended[:2], own),
    }
    return Primitive(works, len(bins.pair_splats))


def discs(gaussians: Gaussians, camera: Camera) -> Primitive:
    """The same for discs, with colour, normals, depths and distortion."""
    flat = replace(gaussians, log_scales=gaussians.log_scales[:, :2].contiguous())
    own = learning(flat)
    projected = projected_discs(own, camera, near=NEAR)
    fixed = type(projected)(*(t.detach() for t in projected))
    channels = torch.cat([projected.colors, projected.normals], dim=-1)
    blended = blend_discs(projected, channels, camera, near=NEAR)
    works: dict[str, Work] = {
        "project forward": lambda: projected_discs(flat, camera, near=NEAR),
        "project backward": backward(projected, own),
        "tiles and blending forward": lambda: blend_discs(fixed, channels.detach(), camera, near=NEAR),
        "all backward": backward(blended, own),
    }
    return Primitive(works, len(bin_tiles(projected.outlines, camera.width, camera.height).pair_splats))


def disc_costs() -> Table:
    """Milliseconds of both primitives, and their ratio."""
    camera, gaussians = bench_camera(WIDTH, HEIGHT), room(COUNT)
    solid, flat = ellipsoids(gaussians, camera), discs(gaussians, camera)
    table = Table(
        f"Discs and ellipsoids, {COUNT // 1000}k Gaussians, {WIDTH}x{HEIGHT}",
        ("step", "ellipsoids, ms", "discs, ms", "ratio"),
        f"{solid.pairs:,} (tile, splat) pairs of ellipsoids with 4 channels, {flat.pairs:,} of discs with 6 and "
        "depths; CPU time.",
    )
    for name, work in solid.works.items():
        seconds = interleaved_seconds({"solid": work, "flat": flat.works[name]}, ROUNDS, time.process_time)
        one, other = (1e3 * min(taken) for taken in seconds.values())
        table.add(name, one, other, other / one)
    return table


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    torch.set_num_threads(1)
    print(disc_costs().markdown())
