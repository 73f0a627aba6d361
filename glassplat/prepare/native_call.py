"""Calls into pycolmap that take minutes: they say how far they are, and Ctrl-C ends them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

from glassplat.data.colmap_library import pycolmap

Result = TypeVar("Result")

LOOK_EVERY = 0.25
"""Seconds between two looks at how far a call is."""


def interruptible(work: Callable[[Any], Result], meanwhile: Callable[[], None] = lambda: None) -> Result:
    """Runs work in a thread, so that signals reach the main thread, which has the work end early.

    Args:
        work: is given the `pycolmap.CancellationToken` to hand on; what knows none runs to its end.
        meanwhile: called a few times a second while the work goes on.

    Raises:
        Exception: what the work raised.
        KeyboardInterrupt: somebody asked for the end, and the work has ended.
    """
    token = pycolmap.CancellationToken()
    results: list[Result] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(work(token))
        except BaseException as error:  # noqa: BLE001 - Raised again where somebody waits.
            errors.append(error)

    thread = threading.Thread(target=run, name="pycolmap", daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(LOOK_EVERY)
            meanwhile()
    except BaseException:
        token.cancel()
        thread.join()  # It writes into the database: whoever goes on from here finds it whole.
        raise
    if errors:
        raise errors[0]
    return results[0]
