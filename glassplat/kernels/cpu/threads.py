"""Which threads run parallel kernels: OpenMP's where there are some, else Numba's own work queue.

Left alone, Numba takes TBB wherever it finds one. TBB's waiting threads take the cores from PyTorch's pool, which makes
training about twice as long, and when the process ends they may wait for each other forever. So TBB comes last, behind
the work queue that is always there. Who sets NUMBA_THREADING_LAYER or NUMBA_THREADING_LAYER_PRIORITY has the choice.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from functools import cache
from typing import Any

import numba

log = logging.getLogger("glassplat.kernels")

PRIORITY = ["omp", "workqueue", "tbb"]
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
