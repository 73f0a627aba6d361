"""Photographs are read in the background while training begins, so that a broken one is found at the start."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Event

from glassplat.data.dataset import Dataset


@contextmanager
def photographs_read(dataset: Dataset) -> Iterator[Callable[[], None]]:
    """Reads all photographs in a thread as long as the context lasts, one after the other.

    Those for testing come first: nothing else would read them before training has ended. They are forgotten again;
    training photographs stay in memory, where training wants them anyway.

    Yields:
        A function that does nothing, or raises the InputError of a photograph that could not be read.
    """
    stop = Event()
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="photographs") as pool:
        reading = pool.submit(_read, dataset, stop)

        def check() -> None:
            if reading.done():
                reading.result()

        try:
            yield check
        finally:
            stop.set()


def _read(dataset: Dataset, stop: Event) -> None:
    for view in dataset.test:
        if stop.is_set():
            return
        view.read_photo()
    for view in dataset.train:
        if stop.is_set():
            return
        _ = view.photo
