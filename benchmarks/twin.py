"""`python -m benchmarks.twin`: the blending kernels compared with C++ loops that are compiled on the spot; one thread.

A reference for the vector code that Numba generates: same algorithm, same tensors, interleaved in one run.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.scene import bench_camera, room
from benchmarks.table import Table
from benchmarks.timing import Work, interleaved_seconds, paired_ratio
from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.composite.cpu import composite_forward
from glassplat.kernels.composite.cpu_backward import composite_backward
from glassplat.kernels.records import Splats, TileBins
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.frame import concat_splats, project_gaussians

SOURCE = Path(__file__).with_name("composite_twin.cpp")
COMPILERS = ("c++", "g++")
FLAGS = (
    *("-O3", "-march=native", "-std=c++17", "-shared", "-fPIC", "-Wno-psabi", "-ffp-contract=fast"),
    *("-fno-math-errno", "-fno-trapping-math", "-fassociative-math", "-fno-signed-zeros", "-freciprocal-math"),
)
"""The same relaxations of floating-point arithmetic as in the kernels."""
CASES = ((100_000, 480, 352), (100_000, 960, 720), (1_000_000, 480, 352))
CHANNELS = 4
ROUNDS = 15

Array = NDArray[Any]


class Blending(NamedTuple):
    """Flat inputs of both passes, and the results of the forward pass that the backward pass needs.

    Attributes:
        splats: means [S, 2], conics [S, 3], opacities [S] and channels [S, 4].
        lists: splat indices of the pairs, offsets of the tiles and offsets of the splats.
        saved: packed splats, blocks reached by each pair, and states of tiles.
        images: blended image and alpha.
        rows: gradient sums of the pairs.
    """

    splats: tuple[Array, ...]
    lists: tuple[Array, ...]
    saved: tuple[Array, ...]
    images: tuple[Array, ...]
    rows: Array


def compiled_library(source: Path, folder: Path) -> ctypes.CDLL | None:
    """Compiles a C++ file into a folder and loads it; None without a compiler."""
    compiler = next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), *COMPILERS))), None)
    if compiler is None:
        return None
    library = folder / f"{source.stem}.so"
    subprocess.run([compiler, *FLAGS, "-o", str(library), str(source)], check=True)
    return ctypes.CDLL(str(library))


def room_splats(count: int, width: int, height: int) -> tuple[Splats, Array, TileBins]:
    """Splats of the benchmark room, their colours and depths, and their tile bins."""
    camera = bench_camera(width, height)
    with torch.no_grad():
        projected = project_gaussians(room(count), camera, near=0.03)
    splats = concat_splats(projected)
    channels = torch.cat([projected.colors, projected.depths[..., None]], dim=-1)
    return splats, channels.numpy().reshape(-1, CHANNELS), bin_tiles(splats, width, height)


def blending(splats: Splats, channels: Array, bins: TileBins) -> Blending:
    """Inputs, and buffers for the results of one side, kernels or twin."""
    fields = [tensor.numpy() for tensor in splats[:3]]
    count, pairs, tiles = len(channels), len(bins.pair_splats), len(bins.active)
    floats = (count * tile.LANES, tiles * tile.STATE, bins.height * bins.width * CHANNELS, bins.height * bins.width)
    packed, state, image, alpha = (torch.zeros(size).numpy() for size in floats)
    return Blending(
        (fields[0].reshape(-1, 2), fields[1].reshape(-1, 3), fields[2].reshape(-1), channels),
        (bins.pair_splats.numpy(), bins.tile_offsets.numpy(), bins.splat_offsets.numpy()),
        (packed, np.zeros(pairs, np.int32), state),
        (image, alpha),
        torch.zeros(pairs * tile.LANES).numpy(),
    )


def kernel_works(given: Blending, bins: TileBins, weights: tuple[Array, Array]) -> dict[str, Work]:
    """Both passes by the kernels of the package."""
    forward, backward = composite_forward(np.float32), composite_backward(np.float32, True)
    active, count = bins.active.numpy(), len(given.splats[3])
    pair_splats, tile_offsets, splat_offsets = given.lists
    none, marks = np.zeros(0, np.float32), np.zeros((1, 0), np.float32)
    return {
        "forward": lambda: forward(
            *given.splats, marks, count, count, bins.width, bins.height, -1, none,
            pair_splats, tile_offsets, splat_offsets, active, *given.saved, none, *given.images, none, none,
        ),
        "backward": lambda: backward(
            count, False, CHANNELS, bins.width, bins.height, -1, False,
            pair_splats, tile_offsets, active, *given.saved, none, *weights, none, none, given.rows,
        ),
    }  # fmt: skip


def twin_works(library: ctypes.CDLL, given: Blending, bins: TileBins, weights: tuple[Array, Array]) -> dict[str, Work]:
    """Both passes by the C++ twin."""
    pair_splats, tile_offsets, splat_offsets = given.lists
    size = ctypes.c_int(bins.width), ctypes.c_int(bins.height)
    count = ctypes.c_long(len(given.splats[3]))
    forward = (*given.splats, count, *size, pair_splats, tile_offsets, splat_offsets, *given.saved, *given.images)
    backward = (*size, pair_splats, tile_offsets, *given.saved, *weights, given.rows)
    return {
        "forward": lambda: library.composite_forward(*map(_passed, forward)),
        "backward": lambda: library.composite_backward(*map(_passed, backward)),
    }


def _passed(value: Any) -> Any:
    """An argument converted for a call into C."""
    return value.ctypes.data_as(ctypes.c_void_p) if isinstance(value, np.ndarray) else value


def add_case(table: Table, library: ctypes.CDLL, case: tuple[int, int, int], rounds: int) -> float:
    """Adds the rows of one case; returns the largest difference between the two images."""
    splats, channels, bins = room_splats(*case)
    generator = np.random.default_rng(0)
    image_weights = generator.standard_normal(bins.width * bins.height * CHANNELS, np.float32)
    weights = image_weights, generator.standard_normal(bins.width * bins.height, np.float32)
    own, twin = blending(splats, channels, bins), blending(splats, channels, bins)
    kernels, loops = kernel_works(own, bins, weights), twin_works(library, twin, bins, weights)
    name = f"{case[0]:,} Gaussians, {bins.width}x{bins.height}, {len(bins.pair_splats):,} pairs"
    for step in ("forward", "backward"):
        seconds = interleaved_seconds({"own": kernels[step], "C++": loops[step]}, rounds, time.process_time)
        medians = (1e3 * statistics.median(taken) for taken in seconds.values())
        table.add(name, step, *medians, paired_ratio(seconds, "own", "C++"))
    return float(np.abs(own.images[0] - twin.images[0]).max())


def main() -> None:
    """Measures and prints the table; exits with a message without a compiler."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.twin", description=__doc__)
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="interleaved repetitions of each pass")
    arguments = parser.parse_args()
    table = Table(
        "Blending by the kernels and by C++", ("case", "pass", "kernel, ms", "C++, ms", "kernel : C++"),
        "Four channels, one thread, CPU time; ratios are medians of ratios taken round by round.",
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        library = compiled_library(SOURCE, Path(folder))
        if library is None:
            sys.exit(f"skipped: no C++ compiler ({', '.join(COMPILERS)} or CXX); install one, such as g++, to measure")
        numba.set_num_threads(1)
        torch.set_num_threads(1)
        largest = max(add_case(table, library, case, arguments.rounds) for case in CASES)
    print(table.markdown())
    print(f"largest difference of the images: {largest:.1e}")


if __name__ == "__main__":
    main()
