"""Checks that results do not depend on the number of threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numba
import torch
from torch import Tensor

MOST = numba.config.NUMBA_NUM_THREADS


def assert_threads_change_no_bit(compute: Callable[[], Iterable[Tensor]]) -> None:
    """Asserts that `compute` gives the same tensors on one thread and on all available ones."""
    assert MOST > 1
    found = []
    for threads in (1, MOST):
        numba.set_num_threads(threads)
        found.append(list(compute()))
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
