"""Latency of the viewer after a move of the camera: python -m benchmarks.looking."""

from __future__ import annotations

import argparse
import statistics
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from io import BytesIO
from typing import NamedTuple

import numba
import numpy as np
from PIL import Image

from benchmarks.methods import doublings, thread_count
from benchmarks.scene import bench_camera, bench_scene
from benchmarks.table import Table
from glassplat.render.planar import Planar
from glassplat.viewer.drawing import ViewRequest, draw_image
from glassplat.viewer.render_loop import ImageArray, RenderLoop, RenderThread
from glassplat.viewer.server import COARSE_QUALITY, SHARP_QUALITY

WIDTH, HEIGHT, COUNT = 640, 480, 100_000
MOST_FIRST, MOST_FULL = 100, 400
"""Targets in milliseconds, on two cores."""
WARM_UP = 5
STEP = 0.02
"""Distance between successive cameras, world units."""
AFTER_FIRST = 0.01
"""Seconds between the first image and the next camera move, while the full image is being rendered."""


class Answer(NamedTuple):
    """Milliseconds from a camera move to its first and to its full image, and the width of the first."""

    first: float
    full: float
    width: int


class Shown(NamedTuple):
    """A sent image: its time, its width, and whether it is the full one."""

    at: float
    width: int
    is_full: bool


class Looker:
    """A simulated user who moves the camera, and records when the encoded images would be sent to the browser."""

    def __init__(self, count: int = COUNT) -> None:
        """Starts rendering a room of `count` Gaussians with one pane over half of the image."""
        camera = bench_camera(WIDTH, HEIGHT)
        self._scene, self._renderer = bench_scene(count, 1, 0.5, camera), Planar()
        self._request = ViewRequest(camera.cam_from_world, 2 * float(np.arctan(HEIGHT / 2 / camera.fy)), WIDTH / HEIGHT)
        self._drawing = self._request
        self._loop: RenderLoop[ViewRequest] = RenderLoop(self._draw, self._show)
        self._shown: list[Shown] = []
        self._changed = threading.Condition()
        self._thread = RenderThread(self._loop)
        threads = numba.get_num_threads()
        self._loop.schedule(lambda: numba.set_num_threads(threads))  # The thread count is per Python thread.

    def stop(self) -> None:
        """Stops the render thread."""
        self._thread.stop()

    def answer(self, place: int, *, moving: bool) -> Answer:
        """Moves the camera to a position, and waits for the full image.

        Args:
            place: number of the position.
            moving: start while the full image at another position is being rendered.
        """
        if moving:
            self._ask(place + 0.5)
            self._wait(lambda: bool(self._shown))
            time.sleep(AFTER_FIRST)
        begun = self._ask(place)
        self._wait(lambda: any(shown.is_full for shown in self._shown))
        first, full = self._shown[0], self._shown[-1]
        return Answer(1e3 * (first.at - begun), 1e3 * (full.at - begun), first.width)

    def _ask(self, place: float) -> float:
        pose = self._request.cam_from_world.clone()
        pose[0, 3] = STEP * place
        with self._changed:
            self._shown.clear()
            self._request = replace(self._request, cam_from_world=pose)
            begun = time.perf_counter()
            self._loop.submit(1, self._request, (WIDTH, HEIGHT))
        return begun

    def _draw(self, request: ViewRequest, rows: int) -> ImageArray:
        self._drawing = request
        return draw_image(self._scene, self._renderer, request, rows)

    def _show(self, client: int, picture: ImageArray, is_full: bool) -> None:
        """Encodes the image as viser does."""
        Image.fromarray(picture).save(BytesIO(), "JPEG", quality=SHARP_QUALITY if is_full else COARSE_QUALITY)
        with self._changed:
            if self._drawing is self._request:
                self._shown.append(Shown(time.perf_counter(), picture.shape[1], is_full))
                self._changed.notify()

    def _wait(self, holds: Callable[[], bool]) -> None:
        with self._changed:
            self._changed.wait_for(holds)


def answers(moves: int, count: int, *, moving: bool) -> list[Answer]:
    """Latencies of `moves` camera moves, after some warm-up moves."""
    looker = Looker(count)
    try:
        return [looker.answer(place, moving=moving) for place in range(WARM_UP + moves)][WARM_UP:]
    finally:
        looker.stop()


def looking_times(moves: int = 40, count: int = COUNT) -> Table:
    """Latency of images after a camera move, from rest and during another frame, for 1, 2, ... threads."""
    table = Table(
        f"From a camera move in the viewer to its image, {count:,} Gaussians, one pane over half of {WIDTH}x{HEIGHT}",
        ("threads", "the camera", "first, ms", "95th percentile", "its width", "full, ms", "95th percentile"),
        f"Medians and 95th percentiles over {moves} moves; encoded for the browser, without the network. "
        f"Targets on two cores: {MOST_FIRST} and {MOST_FULL} ms.",
    )
    for threads in doublings(numba.config.NUMBA_NUM_THREADS):
        with thread_count(threads):
            for moving, named in ((False, "moves from rest"), (True, "moves while a full picture is drawn")):
                found = answers(moves, count, moving=moving)
                first, full = ([getattr(answer, part) for answer in found] for part in ("first", "full"))
                width = round(statistics.median(answer.width for answer in found))
                table.add(
                    threads, named, statistics.median(first), slow(first), width, statistics.median(full), slow(full)
                )
    return table


def slow(times: Sequence[float]) -> float:
    """95th percentile."""
    return float(np.quantile(times, 0.95))


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.looking", description=__doc__)
    parser.add_argument("--moves", type=int, default=40)
    print(looking_times(parser.parse_args().moves).markdown())


if __name__ == "__main__":
    main()
