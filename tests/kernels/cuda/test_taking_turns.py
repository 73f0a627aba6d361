"""Cooperative threads give the same results as a GPU, and reveal results that depend on their order.

`test_simulator.py` runs this file once more with the simulator on.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from glassplat.kernels.backend.devices import SIMULATED

if not SIMULATED:
    pytest.skip("only threads of the simulator take turns", allow_module_level=True)

from numba import cuda

from glassplat.kernels.backend.cuda import kernel
from tests.kernels.cuda.taking_turns import take_turns

take_turns()

THREADS = 64


@kernel("mirror", np.float32, "bool int1")
def mirror(waits, found):
    shared = cuda.shared.array(THREADS, np.int32)
    i = cuda.threadIdx.x
    shared[i] = -1
    cuda.syncthreads()
    shared[i] = 100 * cuda.blockIdx.x + i
    if waits:
        cuda.syncthreads()
    found[cuda.grid(1)] = shared[THREADS - 1 - i]


def mirrored(waits: bool) -> Tensor:
    found = torch.empty(2 * THREADS, dtype=torch.int32)
    mirror(2, THREADS, waits, found)
    return found


def test_shared_values_are_visible_after_a_barrier() -> None:
    assert mirrored(True).view(2, -1).tolist() == [[b + i for i in reversed(range(THREADS))] for b in (0, 100)]


def test_a_missing_barrier_is_detected() -> None:
    assert 0.3 < float((mirrored(False) == -1).double().mean()) < 0.7


@kernel("draw_tickets", np.float32, "int1 int1")
def draw_tickets(last, tickets):
    tickets[cuda.threadIdx.x] = cuda.atomic.add(last, 0, 1)


def test_every_launch_has_its_order() -> None:
    first, second = torch.empty(2, THREADS, dtype=torch.int32)
    for tickets in (first, second):
        draw_tickets(1, THREADS, torch.zeros(1, dtype=torch.int32), tickets)
    assert first.sort().values.tolist() == second.sort().values.tolist() == list(range(THREADS))
    assert not torch.equal(first, second)


@kernel("ask_around", np.float32, "int int1")
def ask_around(ending, found):
    i = cuda.threadIdx.x
    if i < ending:
        return
    found[0] = cuda.syncthreads_or(i == ending)
    found[1] = cuda.syncthreads_and(i > ending)
    if i == ending + 1:
        found[7] = 0


def test_threads_that_have_ended_are_not_waited_for() -> None:
    found = torch.full((8,), -1, dtype=torch.int32)
    ask_around(1, 9, 5, found)
    assert found.tolist() == [1, 0, -1, -1, -1, -1, -1, 0]


def test_an_error_of_a_thread_is_raised() -> None:
    with pytest.raises(IndexError, match="out of bounds"):
        ask_around(1, 9, 5, torch.empty(3, dtype=torch.int32))
