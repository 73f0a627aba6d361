"""Memory between steps: what is freed stays at hand, up to a bound, where the C library can be told so.

Images, packed splats and gradient rows are made anew in every step. glibc gives what is freed back to the system as
soon as it is more than twice the largest of them, and the next step fetches it again page by page, 4 KiB at a time.
Who sets MALLOC_TRIM_THRESHOLD_, MALLOC_MMAP_THRESHOLD_ or GLIBC_TUNABLES has the choice.
"""

from __future__ import annotations

import ctypes
import os

CHOSEN_BY_USER = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Numbers of the two parameters of glibc's `mallopt`."""
KEPT = 128 << 20
"""Bytes of freed memory that a process keeps at the most."""
LARGEST_RECYCLED = 32 << 20
"""Bytes of the largest arrays that are taken from it, the most that glibc allows; larger ones go back when freed."""


def keep_freed_memory() -> bool:
    """Lets this process keep freed memory; False where the user decides, or the C library has no such choice."""
    if any(name in os.environ for name in CHOSEN_BY_USER):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # Not glibc, or not a system with one C library for all.
        return False
    return bool(mallopt(TRIM_THRESHOLD, KEPT)) and bool(mallopt(MMAP_THRESHOLD, LARGEST_RECYCLED))
