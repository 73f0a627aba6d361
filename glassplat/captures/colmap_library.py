"""Lazy import of pycolmap, without its side effects on the process.

Only pose estimation and undistortion need pycolmap, so it is an extra.

Importing it installs a SIGTERM handler that prints a C++ stack trace as after a crash, although job schedulers and
shutdowns end processes by this signal. The previous handler is restored.
"""

from __future__ import annotations

import signal
import threading
from typing import Any

from glassplat.errors import InputError

MISSING = (
    "pycolmap, which estimates camera poses and undistorts photographs, is not installed; run pip install "
    "'glassplat[prepare]'. It is not available for Linux on ARM: prepare the capture on another machine, after "
    "which pycolmap is not needed"
)


def __getattr__(name: str) -> Any:
    """Imports `pycolmap` on first access, which takes a tenth of a second."""
    if name != "pycolmap":
        raise AttributeError(f"module {__name__} has no attribute {name}")
    before = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(MISSING) from error

    # Only the main thread may install signal handlers; None is a handler that Python cannot restore.
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    globals()[name] = pycolmap
    return pycolmap


def quiet_pycolmap() -> None:
    """Silences pycolmap's log; this package reports what matters itself."""
    logging = __getattr__("pycolmap").logging
    logging.minloglevel = int(logging.FATAL)
