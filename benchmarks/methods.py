"""Cost of reflections: frames and training steps of `planar` and `deferred` compared with `splat`, in one run."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from contextlib import contextmanager

import numba
import torch

from benchmarks.scene import bench_camera, bench_scene, glossy_scene
from benchmarks.table import Table
from benchmarks.timing import Work, interleaved_seconds, median_seconds, paired_ratio
from glassplat.captures.view import View
from glassplat.kernels.composite import composite
from glassplat.kernels.tiles import bin_tiles
from glassplat.methods.glossy_recipes import DeferredRecipe
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.render.deferred import INVISIBLE, Deferred
from glassplat.render.frame import NEAR_PER_EXTENT, Renderer, concat_splats, project_gaussians
from glassplat.render.panes import mirrored_views, nearest_hits, panes_in_camera
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene
from glassplat.training.loop import differentiate, update_parameters
from glassplat.training.stage import Stage, TrainState

WIDTH, HEIGHT, COUNT = 480, 360, 100_000
PANES = ((1, 0.5), (3, 0.5), (1, 1.0))


def frame_work(scene: Scene, renderer: Renderer, camera: Camera) -> Work:
    """Renders one frame without gradients."""

    def work() -> None:
        with torch.no_grad():
            renderer(scene, camera)

    return work


def bare_work(scene: Scene, camera: Camera) -> Work:
    """Minimum work of a `planar` frame: the `splat` frame, and the mirrored one in the tiles of the panes."""
    splat, planes = Splat(depth=False), scene.planes
    hits = nearest_hits(panes_in_camera(planes, camera), camera)
    views = mirrored_views(planes, camera)

    def work() -> None:
        with torch.no_grad():
            splat(scene, camera)
            mirrored = project_gaussians(
                scene.primary,
                camera,
                near=NEAR_PER_EXTENT * scene.extent,
                poses=views.poses,
                clip_planes=views.half_spaces,
                windows=hits.windows,
            )
            splats = concat_splats(mirrored)
            composite(splats, mirrored.colors, bin_tiles(splats, camera.width, camera.height, hits.tiles))

    return work


def step_work(scene: Scene, stage: Stage, view: View) -> Work:
    """Runs one optimisation step, without densification."""
    state = TrainState(scene, seed=0)

    def work() -> None:
        result = differentiate(stage, state.scene, view, with_records=True)
        update_parameters(stage, state, result.gradients, iterations=1000)

    return work


def view_of(camera: Camera) -> View:
    """A view with a noise photograph and a mask, to train on."""
    generator = torch.Generator().manual_seed(0)
    photo = (255 * torch.rand(camera.height, camera.width, 3, generator=generator)).to(torch.uint8)
    return View.in_memory(
        "noise", camera, photo=photo, pane_labels=torch.ones(camera.height, camera.width).to(torch.uint8)
    )


def against_splat(method: str, scene: Scene, renderer: Renderer, stage: Stage, view: View) -> list[float]:
    """Milliseconds of a frame in `splat` and in the method, their ratio, and the same for a training step."""
    splat_stage, camera = SplatRecipe().stages(0)[0], view.camera
    frames = interleaved_seconds(
        {"splat": frame_work(scene, Splat(depth=False), camera), method: frame_work(scene, renderer, camera)}
    )
    steps = interleaved_seconds(
        {"splat": step_work(scene, splat_stage, view), method: step_work(scene, stage, view)}, repeats=5
    )
    cells: list[float] = []
    for seconds in (frames, steps):
        cells += [1e3 * statistics.median(seconds[name]) for name in ("splat", method)]
        cells.append(paired_ratio(seconds, method, "splat"))
    return cells


def cost_columns(method: str) -> tuple[str, ...]:
    """Titles of the values of `against_splat`."""
    parts = ("frame", "step")
    return tuple(title for part in parts for title in (f"splat {part}, ms", f"{method} {part}, ms", f"{part} ratio"))


def method_costs() -> Table:
    """Frames and steps of both methods with the same primary Gaussians."""
    camera = bench_camera(WIDTH, HEIGHT)
    view = view_of(camera)
    table = Table(
        f"planar against splat, {COUNT // 1000}k primary Gaussians, SH 3, {WIDTH}x{HEIGHT}",
        ("panes", "share of the image", *cost_columns("planar"), "minimum frame ratio"),
        "Ratios are medians of ratios taken round by round. The planar step is one of stage 3 on an annotated view. "
        "The minimum frame ratio is that of a splat frame plus the bare mirrored images: no glass, no blending.",
    )
    planar_stage = PlanarRecipe().stages(0)[2]
    for number, share in PANES:
        scene = bench_scene(COUNT, number, share, camera)
        cells = against_splat("planar", scene, Planar(), planar_stage, view)
        frames = interleaved_seconds(
            {"splat": frame_work(scene, Splat(depth=False), camera), "bare": bare_work(scene, camera)}
        )
        table.add(number, f"{share:.0%}", *cells, paired_ratio(frames, "bare", "splat"))
    return table


def deferred_costs() -> Table:
    """Frames and steps of `deferred` and `splat` with the same Gaussians."""
    table = Table(
        "deferred against splat, SH 3, every Gaussian glossy",
        ("Gaussians", "pixels", *cost_columns("deferred")),
        "Ratios are medians of ratios taken round by round. Environment: 6 x 128 x 128 texels.",
    )
    deferred_stage = DeferredRecipe().stages(0)[1]
    for count, width, height in ((COUNT, WIDTH, HEIGHT), (COUNT, 2 * WIDTH, 2 * HEIGHT)):
        camera = bench_camera(width, height)
        scene, view = glossy_scene(count), view_of(camera)
        cells = against_splat("deferred", scene, Deferred(depth=False, least_strength=INVISIBLE), deferred_stage, view)
        table.add(f"{count:,}", f"{width}x{height}", *cells)
    return table


def scaling() -> Table:
    """Frame time as a function of the number of Gaussians, pixels, panes and threads."""
    everything = numba.config.NUMBA_NUM_THREADS
    table = Table("Scaling of a frame", ("what", "Gaussians", "pixels", "panes", "threads", "ms", "frames/s"))
    cases = [
        *(("Gaussians", count, (480, 360), 0, everything) for count in (10_000, 100_000, 1_000_000)),
        *(("pixels", COUNT, size, 0, everything) for size in ((240, 180), (480, 360), (960, 720))),
        *(("panes over half of the image", COUNT, (480, 360), number, everything) for number in (1, 2, 4, 8)),
        *(("threads", COUNT, (480, 360), 1, threads) for threads in doublings(everything)),
    ]
    for what, count, (width, height), panes, threads in cases:
        camera = bench_camera(width, height)
        scene = bench_scene(count, panes, 0.5, camera)
        with thread_count(threads):
            seconds = median_seconds(frame_work(scene, Planar() if panes else Splat(depth=False), camera))
        table.add(what, f"{count:,}", f"{width}x{height}", panes, threads, 1e3 * seconds, 1 / seconds)
    return table


def doublings(most: int) -> list[int]:
    """1, 2, 4, ... and `most`."""
    counts = [1]
    while 2 * counts[-1] < most:
        counts.append(2 * counts[-1])
    return [*counts, most] if most > 1 else counts


@contextmanager
def thread_count(threads: int) -> Iterator[None]:
    """Runs kernels and PyTorch on the given number of threads."""
    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(threads)
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])
