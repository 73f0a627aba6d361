"""`python -m benchmarks.rays [--embree FOLDER]`: rays traced through discs, compared with Embree; one thread.

The Embree library comes from `embreex`: `pip install embreex==4.4.0.post1`, or unpack its wheel and pass the folder.
`benchmarks/trace_embree.cpp`, which needs a C++ compiler, gives Embree the same intersection code as our tracer.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import statistics
import sysconfig
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numba
import torch
from torch import Tensor

from benchmarks.kernels import backward
from benchmarks.table import Table
from benchmarks.timing import Work, interleaved_seconds, paired_ratio
from benchmarks.twin import compiled_library
from glassplat.kernels.records import Bvh, RawGaussians, Rays, Shapes
from glassplat.kernels.trace import build_bvh, cpu, reach, shapes_of, trace
from glassplat.kernels.trace.bvh import morton_codes

SOURCE = Path(__file__).with_name("trace_embree.cpp")
COUNTS = (10_000, 100_000, 300_000, 1_000_000)
WIDTH, ROUNDS, SEED = 160, 5, 0
CLEARANCE = 0.3
"""Radius of the mirror ball that reflects the rays."""


class Case(NamedTuple):
    """Activated discs, rays, and the BVH."""

    shapes: Shapes
    rays: Rays
    bvh: Bvh


def surrounding_discs(count: int) -> RawGaussians:
    """Discs in all directions, 1 to 3 from the origin; the more, the smaller, so that hits per ray stay the same."""
    generator = torch.Generator().manual_seed(SEED)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    means = means * (1 + 2 * torch.rand(count, 1, generator=generator))
    # In Morton order, as in training.
    means = means[morton_codes(means).argsort()]
    size = math.log(0.035 * math.sqrt(10_000 / count))
    return RawGaussians(
        means,
        torch.randn(count, 4, generator=generator),
        size + 0.6 * torch.randn(count, 2, generator=generator),
        1.5 * torch.randn(count, generator=generator),
        0.2 * torch.randn(count, 16, 3, generator=generator),
    )


def mirrored_rays(width: int) -> Rays:
    """Camera rays reflected by a mirror ball at the origin, row by row; rays that miss the ball are left out."""
    across = (torch.arange(width) + 0.5) / width * 2 - 1
    y, x = torch.meshgrid(across, across, indexing="ij")
    eye = torch.tensor([0.0, 0.0, -0.9])
    through = torch.stack([0.36 * x, 0.36 * y, torch.ones_like(x)], dim=-1).reshape(-1, 3)
    d = torch.nn.functional.normalize(through, dim=1)
    along = -(d @ eye)
    inside = along**2 - (eye.square().sum() - CLEARANCE**2)
    d, t = d[inside > 0], (along - inside.clamp(min=0).sqrt())[inside > 0]
    places = eye + t[:, None] * d
    normals = places / CLEARANCE
    return Rays(places, d - 2 * (d * normals).sum(1, keepdim=True) * normals)


def own_works(case: Case) -> dict[str, Work]:
    """Tracing without colours, both passes with SH of degree 3, and the construction of the BVH."""
    options: dict[str, Any] = {"flat": True, "near": 0.0}
    colored = cpu.trace(case.shapes, case.rays, case.bvh, degree=3, needs_gradients=True, **options)
    cotangents = [torch.ones_like(output) for output in colored[:3]]
    return {
        "trace": lambda: cpu.trace(case.shapes, case.rays, case.bvh, degree=-1, needs_gradients=False, **options),
        "colored": lambda: cpu.trace(case.shapes, case.rays, case.bvh, degree=3, needs_gradients=True, **options),
        "backward": lambda: cpu.trace_gradients(
            case.shapes, case.rays, case.bvh, colored, cotangents, degree=3, **options
        ),
        "build": lambda: build_bvh(case.shapes, flat=True),
    }


def operation_works(count: int, width: int, device: str) -> dict[str, Work]:
    """The operations on a device: BVH construction, and both passes with SH degree 3 and gradients to all inputs."""
    discs = RawGaussians(*(tensor.to(device).requires_grad_() for tensor in surrounding_discs(count)))
    rays = Rays(*(tensor.to(device).requires_grad_() for tensor in mirrored_rays(width)))
    shapes = Shapes(*(tensor.detach() for tensor in shapes_of(discs)))
    bvh = build_bvh(shapes, flat=True)
    found = list(trace(discs, rays, bvh, sh_degree=3, near=0.0)[:3])
    size = f"{len(rays.origins):,} rays"
    return {
        f"build_bvh, {count:,} discs": lambda: build_bvh(shapes, flat=True),
        f"trace forward, {size}": lambda: trace(discs, rays, bvh, sh_degree=3, near=0.0),
        f"trace backward, {size}": backward(found, [torch.ones_like(x) for x in found], [*discs, *rays]),
    }


class Embree:
    """The Embree library, and the callbacks that define discs."""

    def __init__(self, folder: Path, build: Path) -> None:
        # Loaded in order of dependency: the compiled library needs symbols of these two.
        for pattern in ("libtbb*.so*", "libembree4*.so*"):
            (found,) = (folder / "embreex.libs").glob(pattern)
            ctypes.CDLL(str(found), mode=ctypes.RTLD_GLOBAL)
        library = compiled_library(SOURCE, build)
        if library is None:
            raise OSError("no C++ compiler")
        library.new_device.restype = library.new_scene.restype = ctypes.c_void_p
        self.library = library
        self.device = ctypes.c_void_p(library.new_device())
        self.kept: list[Tensor] = []

    def scene(self, shapes: Shapes, *, robust: bool) -> ctypes.c_void_p:
        """Builds an Embree BVH over discs; the previous scene must not be traced any more."""
        self.kept = [*shapes[:3], reach(shapes.opacities)]
        count, flags = ctypes.c_long(len(shapes.means)), ctypes.c_int(robust)
        return ctypes.c_void_p(self.library.new_scene(self.device, count, flags, *map(address, self.kept)))

    def trace(self, scene: ctypes.c_void_p, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
        """Returns alphas, depths and numbers of hits."""
        count = len(rays.origins)
        found = torch.empty(count), torch.empty(count), torch.empty(count, dtype=torch.int32)
        self.library.trace(scene, ctypes.c_long(count), *map(address, rays), ctypes.c_float(0.0), *map(address, found))
        return found

    def build(self, shapes: Shapes) -> None:
        """Builds a BVH and releases it."""
        self.library.release_scene(self.scene(shapes, robust=False))


def address(tensor: Tensor) -> ctypes.c_void_p:
    """Data pointer of a tensor for a call into C."""
    return ctypes.c_void_p(tensor.data_ptr())


def case_of(count: int, width: int) -> Case:
    """Discs, rays reflected by the mirror ball, and the BVH."""
    with torch.no_grad():
        shapes = Shapes(*(tensor.contiguous() for tensor in shapes_of(surrounding_discs(count))))
    rays = Rays(*(tensor.contiguous() for tensor in mirrored_rays(width)))
    return Case(shapes, rays, build_bvh(shapes, flat=True))


def add_case(tables: tuple[Table, Table], case: Case, embree: Embree | None, rounds: int) -> str:
    """Adds a row to both tables; returns a description of how well the two tracers agree."""
    works, agreement = own_works(case), ""
    found = cpu.trace(case.shapes, case.rays, case.bvh, flat=True, degree=-1, needs_gradients=False, near=0.0)
    if embree is not None:
        scene = embree.scene(case.shapes, robust=False)
        theirs = embree.trace(scene, case.rays)
        same = (theirs[2] == found[3]).float().mean()
        furthest = (theirs[0] - found[1]).abs().max()
        agreement = f"{same:.2%} of the rays have as many hits, alphas differ by at most {furthest:.1e}"
        # Embree's BVH is built last, because its callbacks read the discs of the latest scene.
        works |= {"embree": lambda: embree.trace(scene, case.rays), "embree build": lambda: embree.build(case.shapes)}
    seconds = interleaved_seconds(works, rounds, time.process_time)
    count, rays = f"{len(case.shapes.means):,}", len(found[1])
    mean = {name: statistics.median(taken) for name, taken in seconds.items()}
    beside = ("", "")
    if embree is not None:
        beside = (rays / mean["embree"] / 1e3, paired_ratio(seconds, "embree", "trace"))
    tables[0].add(
        count, float(found[3].float().mean()), rays / mean["trace"] / 1e3, *beside, rays / mean["colored"] / 1e3,
        mean["backward"] / mean["colored"],
    )  # fmt: skip
    tables[1].add(count, *(1e3 * mean[name] if name in mean else "" for name in ("build", "embree build")))
    return agreement


def new_tables(rays: int) -> tuple[Table, Table]:
    """Empty tables of rays per second and of milliseconds of BVH construction."""
    columns = ("discs", "hits a ray", "k rays/s", "Embree, k rays/s", "ours : Embree")
    note = "CPU time, without colours except in the last two columns; ratios are medians of ratios round by round."
    title, built = f"{rays:,} rays of a mirror ball through discs, one thread", ("build", "Embree's build")
    return (
        Table(title, (*columns, "k rays/s, SH 3", "backward : forward"), note),
        Table("BVH construction, milliseconds", ("discs", *built), "CPU time, one thread."),
    )


def main() -> None:
    """Measures and prints both tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rays", description=__doc__)
    parser.add_argument("--embree", type=Path, default=Path(sysconfig.get_path("purelib")), help="holds embreex.libs")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="numbers of discs")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="interleaved repetitions of each measurement")
    parser.add_argument("--width", type=int, default=WIDTH, help="width of the square image of the ball, in pixels")
    arguments = parser.parse_args()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    tables = new_tables(len(mirrored_rays(arguments.width).origins))
    said = []
    with tempfile.TemporaryDirectory() as folder:
        embree = None
        if (arguments.embree / "embreex.libs").is_dir():
            embree = Embree(arguments.embree, Path(folder))
        for count in arguments.counts:
            said.append(add_case(tables, case_of(count, arguments.width), embree, arguments.rounds))
    print("\n".join(table.markdown() for table in tables))
    print("\n".join(said) if embree else "skipped Embree: `pip install embreex==4.4.0.post1`, or --embree FOLDER")


if __name__ == "__main__":
    main()
