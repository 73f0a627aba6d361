"""Reuse of freed memory by a process, observed in the pages that it has to fault in again."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

from glassplat.kernels.backend.cpu import CHOSEN_BY_USER, keep_freed_memory

ROUNDS = """
import resource, numpy
{prepare}

def pages_of_a_round():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays = [numpy.ones(750_000, numpy.float32) for _ in range(30)]
    del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

print([pages_of_a_round() for _ in range(4)][-1])
"""
PAGES = 30 * 3_000_000 // 4096


def pages_again(prepare: str, **environment: str) -> int:
    """Number of pages faulted in by a process that has already held and freed as much."""
    known = {name: value for name, value in os.environ.items() if name not in CHOSEN_BY_USER}
    done = subprocess.run(
        [sys.executable, "-c", ROUNDS.format(prepare=prepare)],
        env=known | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_freed_memory_is_used_again() -> None:
    kept = "from glassplat.kernels.backend import cpu"
    assert pages_again(kept) < PAGES / 20
    assert pages_again("") > PAGES / 2
    assert pages_again(kept, MALLOC_TRIM_THRESHOLD_="1000000") > PAGES / 2


def test_environment_variables_of_glibc_take_precedence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.trim_threshold=1000000")
    assert not keep_freed_memory()


def test_allocator_settings_apply_to_glibc_only(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in CHOSEN_BY_USER:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("ctypes.CDLL", lambda name: object())
    assert not keep_freed_memory()
