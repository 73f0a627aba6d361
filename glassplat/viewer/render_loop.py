"""Pictures for all clients, one at a time: coarse at once, sharp when nobody asks for anything else.

A request has a generation. When a picture is done whose client has meanwhile asked for another view, it is dropped.

One thread draws, since kernels are not entered twice at a time: a `RenderThread`, or one that has other work to do and
keeps what it spends on pictures to a share of its time, a `DrawingShare`.
"""

from __future__ import annotations

import errno
import logging
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from glassplat.errors import InputError

LOCAL = "127.0.0.1"
FIRST_PORT, MOST_PORTS = 8080, 100


def vacant_port(host: str) -> int:
    """The first port from 8080 on that can be used."""
    for port in range(FIRST_PORT, FIRST_PORT + MOST_PORTS):
        try:
            check_port(host, port)
        except InputError:
            continue
        return port
    raise InputError(f"no port from {FIRST_PORT} on can be used; stop the programs that use them")


def check_port(host: str, port: int) -> int:
    """Refuses a port that is taken, or an address that is not this machine's, before anything is served.

    Returns:
        The port; one that is free in place of 0.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
            return int(probe.getsockname()[1])
        except OSError as error:
            if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
                raise InputError(
                    f"{host} is not an address of this machine ({error.strerror or error}); choose another --host"
                ) from error
            reason = "in use by another program" if error.errno == errno.EADDRINUSE else (error.strerror or str(error))
            raise InputError(f"port {port} of {host} cannot be used ({reason}); choose another --port") from error


Wanted = TypeVar("Wanted")
Picture = NDArray[np.uint8]

LEAST_WIDTH = 320
LONGEST_WAIT = 0.5
"""Seconds after which a thread that has nothing to draw looks whether it should end."""
MOST_SHARE = 0.15
"""Of its time, what a program spends on pictures that has other work to do."""
MOST_SAVED = 2.0
"""Seconds of drawing that may be saved up while nobody looks."""
COARSE_SECONDS = 0.08
"""What the first picture after a move may take; its size follows from how long the last ones took."""
SMOOTHING = 0.3
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Request(Generic[Wanted]):
    """The newest request of a client.

    Attributes:
        view: what to draw.
        size: width and height of the sharp picture, pixels.
        generation: counts the requests of all clients.
        is_coarse_shown: whether the coarse picture is there.
    """

    view: Wanted
    size: tuple[int, int]
    generation: int
    is_coarse_shown: bool = False


class RenderLoop(Generic[Wanted]):
    """Knows the newest request of each client, and draws the next picture when it is told to."""

    def __init__(
        self,
        draw: Callable[[Wanted, int], Picture],
        show: Callable[[int, Picture, bool], None],
        fail: Callable[[int, str], None] = lambda client, reason: None,
    ) -> None:
        """Begins to wait for requests.

        Args:
            draw: the picture of a view with so many rows; called by `serve` only.
            show: sends a picture to a client, and says whether it is the sharp one.
            fail: tells a client why its picture could not be drawn.
        """
        self._draw, self._show, self._fail = draw, show, fail
        self._requests: dict[int, Request[Wanted]] = {}
        self._calls: list[Callable[[], None]] = []
        self._changed = threading.Condition()
        self._generation, self._turn = 0, 0
        self._seconds_per_pixel = 1e-7
        self._complaint = ""

    def ask(self, client: int, view: Wanted, size: tuple[int, int]) -> None:
        """Replaces what a client wants to see."""
        with self._changed:
            self._generation += 1
            self._requests[client] = Request(view, size, self._generation)
            self._changed.notify()

    def forget(self, client: int) -> None:
        """A client has gone."""
        with self._changed:
            self._requests.pop(client, None)

    def call(self, work: Callable[[], None]) -> None:
        """Has something done by the thread that draws, before the next picture."""
        with self._changed:
            self._calls.append(work)
            self._changed.notify()

    def serve(self) -> bool:
        """Draws a picture or does what was called for, if there is any, and returns whether; for one thread only."""
        with self._changed:
            call = self._calls.pop(0) if self._calls else None
            if call is None and not self._requests:
                return False
            waiting = None if call else self._next()
        try:
            if waiting is not None:
                self._serve(*waiting)
            elif call is not None:
                call()
        except Exception as error:  # noqa: BLE001 - Of one client or picture; the thread, maybe a training, goes on.
            self._complain(error)
        return True

    def wait(self, seconds: float) -> None:
        """Waits until somebody asks for something, or for so long."""
        with self._changed:
            if not self._requests and not self._calls:
                self._changed.wait(seconds)

    def expected_seconds(self) -> float | None:
        """Expected seconds of the next picture, which is called for nothing; None if nobody waits."""
        with self._changed:
            if self._calls:
                return 0.0
            if not self._requests:
                return None
            turn = self._turn
            _, request = self._next()
            self._turn = turn
        width, height = request.size
        rows = height if request.is_coarse_shown else self.coarse_height(request.size)
        return self._seconds_per_pixel * width * rows * rows / height

    def coarse_height(self, size: tuple[int, int]) -> int:
        """Rows of a picture that can be drawn in `COARSE_SECONDS`; no narrower than `LEAST_WIDTH`."""
        width, height = size
        share = (COARSE_SECONDS / (self._seconds_per_pixel * width * height)) ** 0.5
        return max(1, round(height * min(1.0, max(share, LEAST_WIDTH / width))))

    def _next(self) -> tuple[int, Request[Wanted]]:
        """Clients that see nothing of their view yet come first, in turn."""
        waiting = [client for client, request in self._requests.items() if not request.is_coarse_shown]
        clients = sorted(waiting or self._requests)
        client = next((one for one in clients if one > self._turn), clients[0])
        self._turn = client
        return client, self._requests[client]

    def _serve(self, client: int, request: Request[Wanted]) -> None:
        height = request.size[1]
        coarse = self.coarse_height(request.size)
        is_sharp = request.is_coarse_shown or coarse >= height
        rows = height if is_sharp else coarse
        picture = self._draw_timed(client, request.view, rows)
        with self._changed:
            current = self._requests.get(client)
            if current is None or current.generation != request.generation:
                return
            if is_sharp:
                del self._requests[client]
            else:
                self._requests[client] = Request(request.view, request.size, request.generation, True)
        if picture is not None:
            self._show(client, picture, is_sharp)

    def _draw_timed(self, client: int, view: Wanted, rows: int) -> Picture | None:
        """A picture; what goes wrong with one must not end the others."""
        begun = time.perf_counter()
        try:
            picture = self._draw(view, rows)
        except Exception as error:  # noqa: BLE001 - A photograph that is gone, no memory: whatever it was.
            self._fail(client, self._complain(error))
            return None
        seconds = (time.perf_counter() - begun) / (picture.shape[0] * picture.shape[1])
        self._seconds_per_pixel += SMOOTHING * (seconds - self._seconds_per_pixel)
        return picture

    def _complain(self, error: Exception) -> str:
        """The error as text, which is logged unless the last one was the same."""
        text = str(error) or type(error).__name__
        if text != self._complaint:
            logger.warning("a view could not be drawn: %s", text)
        self._complaint = text
        return text


class RenderThread:
    """A thread that does nothing but draw."""

    def __init__(self, loop: RenderLoop[Any]) -> None:
        """Begins to draw."""
        self._loop, self._stopped = loop, False
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread, after the picture that it is drawing."""
        self._stopped = True
        self._thread.join()

    def _run(self) -> None:
        while not self._stopped:
            if not self._loop.serve():
                self._loop.wait(LONGEST_WAIT)


class DrawingShare:
    """Keeps the drawing of a program that has other work to a share of its time, and to nothing while nobody looks."""

    def __init__(self, loop: RenderLoop[Any], clock: Callable[[], float] = time.perf_counter) -> None:
        """Counts from now on; a picture may be drawn at once."""
        self._loop, self._clock = loop, clock
        self._saved, self._since = MOST_SAVED, clock()

    def draw(self) -> None:
        """To be called between two pieces of work: draws what there is time for."""
        worked = self._clock() - self._since
        self._saved = min(self._saved + MOST_SHARE * worked, MOST_SAVED)
        while (expected := self._loop.expected_seconds()) is not None and self._saved >= min(expected, MOST_SAVED):
            begun = self._clock()
            self._loop.serve()
            self._saved -= self._clock() - begun
        self._since = self._clock()
