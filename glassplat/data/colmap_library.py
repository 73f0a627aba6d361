"""pycolmap, without what importing it does to the process.

It installs a handler that answers SIGTERM, with which job schedulers and shut-downs end a process, like a crash: with a
stack of its C++ functions. Whatever answered before does so again.
"""

from __future__ import annotations

import signal
import threading

_before = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

# Only the main thread may say how signals are answered; None stands for what Python does not know and cannot restore.
if _before is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _before)

__all__ = ["pycolmap"]
