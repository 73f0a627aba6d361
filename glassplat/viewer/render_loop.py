"""Rendering for all clients, one image at a time: coarse at once, full resolution when no other request waits.

Each request has a generation. An image is dropped if its client has requested another view since.

Only one thread renders, because kernels are not reentrant: a `RenderThread`, or a thread with other work that limits
the share of its time spent on rendering by a `RenderBudget`.
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

FIRST_PORT, MOST_PORTS = 8080, 100


def vacant_port(host: str) -> int:
    """The first usable port, starting at 8080."""
    for port in range(FIRST_PORT, FIRST_PORT + MOST_PORTS):
        try:
            check_port(host, port)
        except InputError:
            continue
        return port
    raise InputError(f"none of the {MOST_PORTS} ports from {FIRST_PORT} can be used; close programs that use them")


def check_port(host: str, port: int) -> int:
    """Refuses a port in use, or an address that is not one of this machine, before the server starts.

    Returns:
        The port; a free one instead of 0.
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


ViewT = TypeVar("ViewT")
ImageArray = NDArray[np.uint8]

LEAST_WIDTH = 320
LONGEST_WAIT = 0.5
"""Seconds after which an idle thread checks if it should end."""
MOST_SHARE = 0.15
"""Maximum share of its time that a program with other work spends on rendering."""
MOST_SAVED = 2.0
"""Maximum rendering time, in seconds, that accumulates while there are no requests."""
COARSE_SECONDS = 0.08
"""Target time of the first image after a move; its size follows from the time of previous images."""
SMOOTHING = 0.3
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Request(Generic[ViewT]):
    """The newest request of a client.

    Attributes:
        view: the view to render.
        size: width and height of the full-resolution image, pixels.
        generation: counts the requests of all clients.
        is_coarse_shown: the client has the coarse image.
    """

    view: ViewT
    size: tuple[int, int]
    generation: int
    is_coarse_shown: bool = False


class RenderLoop(Generic[ViewT]):
    """Newest request of each client; `serve` renders the next image."""

    def __init__(
        self,
        draw: Callable[[ViewT, int], ImageArray],
        show: Callable[[int, ImageArray, bool], None],
        fail: Callable[[int, str], None] = lambda client, reason: None,
    ) -> None:
        """Starts without requests.

        Args:
            draw: renders a view with the given number of rows; called by `serve` only.
            show: sends an image to a client; the flag is true at full resolution.
            fail: notifies a client of the reason why rendering failed.
        """
        self._draw, self._show, self._fail = draw, show, fail
        self._requests: dict[int, Request[ViewT]] = {}
        self._calls: list[Callable[[], None]] = []
        self._changed = threading.Condition()
        self._generation, self._turn = 0, 0
        self._seconds_per_pixel = 1e-7
        self._last_error = ""

    def submit(self, client: int, view: ViewT, size: tuple[int, int]) -> None:
        """Replaces the request of a client."""
        with self._changed:
            self._generation += 1
            self._requests[client] = Request(view, size, self._generation)
            self._changed.notify()

    def forget(self, client: int) -> None:
        """Drops the request of a client that has disconnected."""
        with self._changed:
            self._requests.pop(client, None)

    def schedule(self, work: Callable[[], None]) -> None:
        """Schedules a call on the rendering thread, before the next image."""
        with self._changed:
            self._calls.append(work)
            self._changed.notify()

    def serve(self) -> bool:
        """Renders an image or runs a scheduled call; returns false if there is neither. For one thread only."""
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
        except Exception as error:  # noqa: BLE001 - The thread, which may be training, continues.
            self._log_error(error)
        return True

    def wait(self, seconds: float) -> None:
        """Waits for a request, for at most this long."""
        with self._changed:
            if not self._requests and not self._calls:
                self._changed.wait(seconds)

    def expected_seconds(self) -> float | None:
        """Expected seconds of the next image, 0 for a scheduled call; None if there is no request."""
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
        """Rows of an image that can be rendered in `COARSE_SECONDS`, but at least `LEAST_WIDTH` wide."""
        width, height = size
        share = (COARSE_SECONDS / (self._seconds_per_pixel * width * height)) ** 0.5
        return max(1, round(height * min(1.0, max(share, LEAST_WIDTH / width))))

    def _next(self) -> tuple[int, Request[ViewT]]:
        """The next client and its request, in turn; clients without a coarse image come first."""
        waiting = [client for client, request in self._requests.items() if not request.is_coarse_shown]
        clients = sorted(waiting or self._requests)
        client = next((one for one in clients if one > self._turn), clients[0])
        self._turn = client
        return client, self._requests[client]

    def _serve(self, client: int, request: Request[ViewT]) -> None:
        height = request.size[1]
        coarse = self.coarse_height(request.size)
        is_sharp = request.is_coarse_shown or coarse >= height
        rows = height if is_sharp else coarse
        image = self._draw_timed(client, request.view, rows)
        with self._changed:
            current = self._requests.get(client)
            if current is None or current.generation != request.generation:
                return
            if is_sharp:
                del self._requests[client]
            else:
                self._requests[client] = Request(request.view, request.size, request.generation, True)
        if image is not None:
            self._show(client, image, is_sharp)

    def _draw_timed(self, client: int, view: ViewT, rows: int) -> ImageArray | None:
        """The rendered image; None on failure, which must not affect other clients."""
        begun = time.perf_counter()
        try:
            image = self._draw(view, rows)
        except Exception as error:  # noqa: BLE001 - Any failure, such as a missing photograph or no memory.
            self._fail(client, self._log_error(error))
            return None
        seconds = (time.perf_counter() - begun) / (image.shape[0] * image.shape[1])
        self._seconds_per_pixel += SMOOTHING * (seconds - self._seconds_per_pixel)
        return image

    def _log_error(self, error: Exception) -> str:
        """The error as text; it is logged unless it repeats the previous one."""
        text = str(error) or type(error).__name__
        if text != self._last_error:
            log.warning("a view could not be rendered: %s", text)
        self._last_error = text
        return text


class RenderThread:
    """A thread dedicated to rendering."""

    def __init__(self, loop: RenderLoop[Any]) -> None:
        """Starts the thread."""
        self._loop, self._stopped = loop, False
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread after the current image."""
        self._stopped = True
        self._thread.join()

    def _run(self) -> None:
        while not self._stopped:
            if not self._loop.serve():
                self._loop.wait(LONGEST_WAIT)


class RenderBudget:
    """Limits rendering in a program with other work to a share of its time; without requests it takes none."""

    def __init__(self, loop: RenderLoop[Any], clock: Callable[[], float] = time.perf_counter) -> None:
        """Starts with enough saved time to render at once."""
        self._loop, self._clock = loop, clock
        self._saved_seconds, self._since = MOST_SAVED, clock()

    def draw(self) -> None:
        """Renders as much as there is time for; to be called between two pieces of work."""
        worked = self._clock() - self._since
        self._saved_seconds = min(self._saved_seconds + MOST_SHARE * worked, MOST_SAVED)
        while (needed := self._loop.expected_seconds()) is not None and self._saved_seconds >= min(needed, MOST_SAVED):
            begun = self._clock()
            self._loop.serve()
            self._saved_seconds -= self._clock() - begun
        self._since = self._clock()
