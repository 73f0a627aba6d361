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
"""Milliseconds that are aimed at, on two cores."""
WARM_UP = 5
STEP = 0.02
"""World units from one camera to the next."""
AFTER_FIRST = 0.01
"""Seconds after the first picture at which the camera moves again, while the full one is being drawn."""


class Answer(NamedTuple):
    """Milliseconds from a move to its first picture and to the full one, and how wide the first one is."""

    first: float
    full: float
    width: int


class Shown(NamedTuple):
    """A picture that was sent: when, how wide, and whether it is the full one."""

    at: float
    width: int
    is_full: bool


class Looker:
    """Somebody who moves, waits for the pictures as they go to the browser, and notes when they come."""

    def __init__(self, count: int = COUNT) -> None:
        """Begins to look at a room of so many Gaussians with one pane over half of the picture."""
        camera = bench_camera(WIDTH, HEIGHT)
        self._scene, self._renderer = bench_scene(count, 1, 0.5, camera), Planar()
        self._request = ViewRequest(camera.cam_from_world, 2 * float(np.arctan(HEIGHT / 2 / camera.fy)), WIDTH / HEIGHT)
        self._drawing = self._request
        self._loop: RenderLoop[ViewRequest] = RenderLoop(self._draw, self._show)
        self._shown: list[Shown] = []
        self._changed = threading.Condition()
        self._thread = RenderThread(self._loop)
        threads = numba.get_num_threads()
        self._loop.schedule(lambda: numba.set_num_threads(threads))  # Each Python thread has a number of its own.

    def stop(self) -> None:
        """Ends the drawing."""
        self._thread.stop()

    def answer(self, place: int, *, moving: bool) -> Answer:
        """Moves to a place, and waits for the full picture.

        Args:
            place: number of the place.
            moving: begin while the full picture of another place is being drawn.
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
        """Packs the picture as viser does."""
        Image.fromarray(picture).save(BytesIO(), "JPEG", quality=SHARP_QUALITY if is_full else COARSE_QUALITY)
        with self._changed:
            if self._drawing is self._request:
                self._shown.append(Shown(time.perf_counter(), picture.shape[1], is_full))
                self._changed.notify()

    def _wait(self, holds: Callable[[], bool]) -> None:
        with self._changed:
            self._changed.wait_for(holds)


def answers(moves: int, count: int, *, moving: bool) -> list[Answer]:
    """Latencies of a number of moves, after some to warm up."""
    looker = Looker(count)
    try:
        return [looker.answer(place, moving=moving) for place in range(WARM_UP + moves)][WARM_UP:]
    finally:
        looker.stop()


def looking_times(moves: int = 40, count: int = COUNT) -> Table:
    """From a move of the camera to its pictures, from rest and while another one is drawn, for 1, 2, ... threads."""
    table = Table(
        f"From a move in the viewer to its picture, {count:,} Gaussians, one pane over half of {WIDTH}x{HEIGHT}",
        ("threads", "the camera", "first, ms", "slowest of 20", "its width", "full, ms", "slowest of 20"),
        f"Medians over {moves} moves, and what one in twenty exceeds; packed for the browser, without its way there. "
        f"Aims on two cores: {MOST_FIRST} and {MOST_FULL} ms.",
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
