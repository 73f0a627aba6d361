"""Which threads run parallel kernels: OpenMP's where there are some, else Numba's own work queue.

Left alone, Numba takes TBB wherever it finds one. TBB's waiting threads take the cores from PyTorch's pool, which makes
training about twice as long, and when the process ends they may wait for each other forever. So TBB comes last, behind
the work queue that is always there. Who sets NUMBA_THREADING_LAYER or NUMBA_THREADING_LAYER_PRIORITY has the choice.

Waking a thread that sleeps and waiting for it takes longer than many a kernel, and on a busy machine far longer. So
launches that are over sooner than that stay on the thread they come from; results do not depend on it.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np

log = logging.getLogger("glassplat.kernels")

PRIORITY = ["omp", "workqueue", "tbb"]
SHORTEST_SHARED = 3e-4
"""Seconds on one thread from which on a launch is shared with others."""
FORGETTING = 1.01
"""Growth, from one launch to the next, of the least time that an element of the arguments has taken."""
LOOK_AGAIN = 200
"""Every so many launches one is timed on one thread, however long it takes."""
NAMES = {"omp": "OpenMP", "workqueue": "Numba's work queue", "tbb": "TBB"}

_alone = threading.Lock()


def prefer_openmp() -> None:
    """Puts TBB last, unless the user has said what comes first; before Numba starts its threads."""
    if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
        numba.config.THREADING_LAYER_PRIORITY = PRIORITY


@cache
def threading_layer() -> str:
    """Numba's threading layer, `omp`, `workqueue` or `tbb`; starts its threads, and says which, at the first call."""
    prefer_openmp()  # Again: Numba reads its variables anew when the environment has changed.
    threads = numba.get_num_threads()
    layer = str(numba.threading_layer())
    log.info("kernels run on %d threads of %s", threads, NAMES.get(layer, layer))
    return layer


def entrance(compiled: Callable[..., Any]) -> Callable[..., Any]:
    """A parallel kernel as any thread may call it: the work queue ends the process when two threads are in it."""
    if threading_layer() != "workqueue":
        return compiled

    def enter(*arguments: Any) -> Any:
        with _alone:
            return compiled(*arguments)

    return enter


class Launches:
    """A parallel kernel that leaves the other threads asleep where there is little to do.

    How long a launch takes on one thread is foretold from the elements of its arrays, and from the least time that one
    of them has taken so far: what else the machine does makes single launches longer, and none shorter.
    """

    def __init__(self, run: Callable[..., Any]) -> None:
        self._run = run
        self._count = 0
        self._seconds_per_element = 0.0

    def __call__(self, *arguments: Any) -> Any:
        """Runs the kernel on as many threads as its work is worth."""
        threads = numba.get_num_threads()
        if threads == 1:
            return self._run(*arguments)
        self._count += 1
        elements = 1 + sum([argument.size for argument in arguments if type(argument) is np.ndarray])
        if elements * self._seconds_per_element >= SHORTEST_SHARED and self._count % LOOK_AGAIN:
            return self._run(*arguments)
        numba.set_num_threads(1)
        try:
            started = time.perf_counter()
            result = self._run(*arguments)
            self._learn((time.perf_counter() - started) / elements)
        finally:
            numba.set_num_threads(threads)
        return result

    def _learn(self, taken: float) -> None:
        """Notes what an element took on one thread; the first launch, which may compile the kernel, tells nothing."""
        if self._count > 1:
            known = self._seconds_per_element or taken
            self._seconds_per_element = min(known * FORGETTING, taken)
