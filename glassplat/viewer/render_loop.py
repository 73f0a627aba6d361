"""One thread that renders for all clients: coarse at once, sharp when nobody asks for anything else.

A wish has a generation. When a picture is done whose client has meanwhile asked for another view, it is dropped.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Wanted = TypeVar("Wanted")
Picture = NDArray[np.uint8]

LEAST_WIDTH = 320
COARSE_SECONDS = 0.08
"""What the first picture after a move may take; its size follows from how long the last ones took."""
SMOOTHING = 0.3
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Request(Generic[Wanted]):
    """The newest wish of a client.

    Attributes:
        wish: what to draw.
        size: width and height of the sharp picture, pixels.
        generation: counts the wishes of all clients.
        is_coarse_shown: whether the coarse picture is there.
    """

    wish: Wanted
    size: tuple[int, int]
    generation: int
    is_coarse_shown: bool = False


class RenderLoop(Generic[Wanted]):
    """Draws the newest wish of each client, in a thread of its own."""

    def __init__(self, draw: Callable[[Wanted, int], Picture], show: Callable[[int, Picture, bool], None]) -> None:
        """Begins to wait for wishes.

        Args:
            draw: the picture of a wish with so many rows; called from one thread only.
            show: sends a picture to a client, and says whether it is the sharp one.
        """
        self._draw, self._show = draw, show
        self._requests: dict[int, Request[Wanted]] = {}
        self._changed = threading.Condition()
        self._generation, self._turn, self._stopped = 0, 0, False
        self._seconds_per_pixel = 1e-7
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)
        self._thread.start()

    def ask(self, client: int, wish: Wanted, size: tuple[int, int]) -> None:
        """Replaces what a client wants to see."""
        with self._changed:
            self._generation += 1
            self._requests[client] = Request(wish, size, self._generation)
            self._changed.notify()

    def forget(self, client: int) -> None:
        """A client has gone."""
        with self._changed:
            self._requests.pop(client, None)

    def stop(self) -> None:
        """Ends the thread, after the picture that it is drawing."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join()

    def coarse_height(self, size: tuple[int, int]) -> int:
        """Rows of a picture that can be drawn in `COARSE_SECONDS`; no narrower than `LEAST_WIDTH`."""
        width, height = size
        share = (COARSE_SECONDS / (self._seconds_per_pixel * width * height)) ** 0.5
        return max(1, round(height * min(1.0, max(share, LEAST_WIDTH / width))))

    def _run(self) -> None:
        while True:
            with self._changed:
                while not (self._stopped or self._requests):
                    self._changed.wait()
                if self._stopped:
                    return
                client, request = self._next()
            self._serve(client, request)

    def _next(self) -> tuple[int, Request[Wanted]]:
        """Clients that see nothing of their wish yet come first, in turn."""
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
        picture = self._timed(request.wish, rows)
        with self._changed:
            current = self._requests.get(client)
            if current is None or current.generation != request.generation:
                return
            if is_sharp:
                del self._requests[client]
            else:
                self._requests[client] = Request(request.wish, request.size, request.generation, True)
        if picture is not None:
            self._show(client, picture, is_sharp)

    def _timed(self, wish: Wanted, rows: int) -> Picture | None:
        """A picture; what goes wrong with one must not end the others."""
        begun = time.perf_counter()
        try:
            picture = self._draw(wish, rows)
        except (RuntimeError, ValueError) as error:
            logger.warning("a view could not be drawn: %s", error)
            return None
        seconds = (time.perf_counter() - begun) / (picture.shape[0] * picture.shape[1])
        self._seconds_per_pixel += SMOOTHING * (seconds - self._seconds_per_pixel)
        return picture
