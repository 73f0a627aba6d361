"""pycolmap, when it is first asked for, and without what importing it does to the process.

Only finding out where photographs were taken, and taking the distortion of a lens out of them, need it: it is an extra.

It installs a handler that answers SIGTERM, with which job schedulers and shut-downs end a process, like a crash: with a
stack of its C++ functions. Whatever answered before does so again.
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
    """`pycolmap`, which takes a tenth of a second to import."""
    if name != "pycolmap":
        raise AttributeError(f"module {__name__} has no attribute {name}")
    before = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(MISSING) from error

    # Only the main thread may say how signals are answered; None stands for what Python cannot restore.
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    globals()[name] = pycolmap
    return pycolmap


def quiet_pycolmap() -> None:
    """Keeps pycolmap from printing; what matters of it is said in this package's own words."""
    logging = __getattr__("pycolmap").logging
    logging.minloglevel = int(logging.FATAL)
