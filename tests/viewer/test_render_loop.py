"""The render loop: coarse before sharp, nothing stale, all clients in turn, one image at a time."""

from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from glassplat.errors import InputError
from glassplat.viewer import render_loop
from glassplat.viewer.render_loop import (
    LEAST_WIDTH,
    MOST_SHARE,
    ImageArray,
    RenderBudget,
    RenderLoop,
    RenderThread,
    check_port,
)
from tests.viewer.free_port import free_port

SIZE = (1280, 720)


class Recorder:
    """Draws grey images of the value of their view, once permitted, and records the displayed ones."""

    def __init__(self, *, held: bool = False) -> None:
        self.drawn: list[tuple[int, int]] = []
        self.shown: list[tuple[int, int, bool]] = []
        self.let = threading.Event()
        self.most_at_once, self._at_once = 0, 0
        if not held:
            self.let.set()
        self.loop: RenderLoop[int] = RenderLoop(self.draw, self.show)
        self.thread = RenderThread(self.loop)

    def draw(self, view: int, rows: int) -> ImageArray:
        self._at_once += 1
        self.most_at_once = max(self.most_at_once, self._at_once)
        self.drawn.append((view, rows))
        self.let.wait()
        if view < 0:
            self._at_once -= 1
            raise ValueError("cannot be drawn")
        time.sleep(0.01 * rows / SIZE[1])
        self._at_once -= 1
        return np.full((rows, round(rows * SIZE[0] / SIZE[1]), 3), view, dtype=np.uint8)

    def show(self, client: int, picture: ImageArray, is_sharp: bool) -> None:
        self.shown.append((client, int(picture[0, 0, 0]), is_sharp))


def wait_until(condition: Callable[[], bool]) -> None:
    while not condition():
        time.sleep(0.002)


def slow(recorder: Recorder) -> None:
    """Makes a sharp image take ten times as long as a coarse one may."""
    recorder.loop._seconds_per_pixel = 1e-6


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "::"])
def test_a_port_of_any_address_of_this_machine_is_checked(host: str) -> None:
    if ":" in host:
        with socket.socket(socket.AF_INET6) as probe:
            if probe.connect_ex(("::1", free_port())) == errno.EADDRNOTAVAIL:
                pytest.skip("this machine has no IPv6")
    port = free_port()
    assert check_port(host, port) == port and check_port(host, 0) > 0
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as taken:
        taken.bind((host, 0))
        taken.listen()
        with pytest.raises(InputError, match="in use"):
            check_port(host, taken.getsockname()[1])


def test_a_coarse_image_is_followed_by_a_sharp_one() -> None:
    recorder = Recorder(held=True)
    slow(recorder)
    recorder.loop.submit(1, 7, SIZE)
    recorder.let.set()
    wait_until(lambda: len(recorder.shown) == 2)
    recorder.thread.stop()
    assert recorder.shown == [(1, 7, False), (1, 7, True)]
    (_, coarse), (_, sharp) = recorder.drawn
    assert sharp == SIZE[1] and coarse < sharp and coarse * SIZE[0] / SIZE[1] >= LEAST_WIDTH - 1


def test_fast_images_are_drawn_sharp_at_once() -> None:
    recorder = Recorder()
    recorder.loop.submit(1, 7, (640, 360))
    wait_until(lambda: bool(recorder.shown))
    recorder.thread.stop()
    assert recorder.shown == [(1, 7, True)]


def test_outdated_images_are_not_shown() -> None:
    recorder = Recorder(held=True)
    recorder.loop.submit(1, 1, SIZE)
    wait_until(lambda: len(recorder.drawn) == 1)
    for view in (2, 3, 4):
        recorder.loop.submit(1, view, SIZE)
    recorder.let.set()
    wait_until(lambda: (1, 4, True) in recorder.shown)
    recorder.thread.stop()
    assert {view for _, view, _ in recorder.shown} == {4}


def test_clients_take_turns_and_one_picture_is_drawn_at_a_time() -> None:
    recorder = Recorder(held=True)
    slow(recorder)
    for client in range(5):
        recorder.loop.submit(client, 10 + client, SIZE)
    recorder.let.set()
    wait_until(lambda: sum(sharp for *_, sharp in recorder.shown) == 5)
    recorder.thread.stop()
    assert {client for client, *_ in recorder.shown[:5]} == set(range(5))
    assert recorder.most_at_once == 1


def test_disconnected_clients_are_removed_and_errors_stop_nothing() -> None:
    recorder = Recorder(held=True)
    recorder.loop.submit(1, 1, SIZE)
    wait_until(lambda: len(recorder.drawn) == 1)
    recorder.loop.forget(1)
    recorder.loop.submit(2, -1, SIZE)
    recorder.loop.submit(3, 3, SIZE)
    recorder.let.set()
    wait_until(lambda: (3, 3, True) in recorder.shown)
    recorder.thread.stop()
    assert {client for client, *_ in recorder.shown} == {3}


def test_without_a_free_port_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(host: str, port: int) -> int:
        raise InputError(f"port {port} is in use")

    monkeypatch.setattr(render_loop, "check_port", refuse)
    with pytest.raises(InputError, match="none of the 100 ports from 8080 can be used"):
        render_loop.vacant_port("127.0.0.1")


def test_requests_run_in_the_drawing_thread() -> None:
    recorder = Recorder(held=True)
    threads: list[str] = []
    recorder.loop.submit(1, 1, SIZE)
    wait_until(lambda: len(recorder.drawn) == 1)
    recorder.loop.schedule(lambda: threads.remove("nobody"))  # An error ends nothing.
    for _ in range(2):
        recorder.loop.schedule(lambda: threads.append(threading.current_thread().name))
    recorder.let.set()
    wait_until(lambda: len(threads) == 2)
    recorder.loop.schedule(lambda: threads.append("while nothing is drawn"))
    wait_until(lambda: len(threads) == 3)
    recorder.thread.stop()
    assert threads[:2] == ["render", "render"]


class Clock:
    """Time that advances when an image is drawn, or when a test sets it."""

    def __init__(self) -> None:
        self.now, self.drawing = 0.0, 0.0
        self.loop: RenderLoop[int] = RenderLoop(self.draw, lambda *shown: None)
        self.share = RenderBudget(self.loop, lambda: self.now)

    def draw(self, view: int, rows: int) -> ImageArray:
        seconds = 1e-6 * rows * rows * SIZE[0] / SIZE[1]
        self.now, self.drawing = self.now + seconds, self.drawing + seconds
        return np.zeros((rows, round(rows * SIZE[0] / SIZE[1]), 3), dtype=np.uint8)


def test_drawing_takes_its_share_of_the_time_and_no_more() -> None:
    clock = Clock()
    clock.share.draw()
    assert clock.drawing == 0
    for step in range(2000):
        clock.loop.submit(step % 3, step, SIZE)
        clock.now += 0.2
        clock.share.draw()
    assert 0.5 * MOST_SHARE < clock.drawing / clock.now <= MOST_SHARE


def test_requests_are_not_delayed_by_the_frame_budget() -> None:
    clock = Clock()
    done: list[bool] = []
    clock.loop.schedule(lambda: done.append(True))
    clock.share.draw()
    assert done and clock.loop.expected_seconds() is None


def test_a_slow_image_is_drawn_beyond_the_time_budget() -> None:
    clock = Clock()
    clock.loop._seconds_per_pixel = 1e-3
    clock.loop.submit(1, 1, SIZE)
    clock.share.draw()
    assert clock.drawing > 0
