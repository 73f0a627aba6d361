"""The second and a half in which PyTorch is imported: once nothing is left to refuse, and with a line that says so."""

from __future__ import annotations

import gc
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.control import Control, ControlType

from glassplat.commands.console.messages import message_console
from glassplat.commands.console.signals import held_signals

LINE = "loading PyTorch ..."
"""Shown in a terminal only, and gone when the work begins. The cursor stays: Ctrl-C may end the process at once."""


def import_now(module: str, console: Console | None = None) -> Any:
    """A module of `glassplat` that imports PyTorch, imported now if it is not there yet.

    Args:
        module: its dotted name.
        console: where the line appears; that of standard error if not given.
    """
    console = console or message_console(stderr=True)
    with _uncollected(), _announced(console, module):
        return importlib.import_module(module)


def import_held(module: str) -> Any:
    """The same while a command works: signals are answered after the import, which must not break off."""
    with held_signals():
        return import_now(module)


@contextmanager
def _announced(console: Console, module: str) -> Iterator[None]:
    """Shows the line meanwhile, where somebody may be watching and the module is not there yet."""
    if module in sys.modules or not console.is_terminal:
        yield
        return
    console.print(LINE, end="", highlight=False)
    try:
        yield
    finally:
        console.control(Control(ControlType.CARRIAGE_RETURN, (ControlType.ERASE_IN_LINE, 2)))


@contextmanager
def _uncollected() -> Iterator[None]:
    """Keeps Python from looking for garbage among what is imported, now and later: all of it stays to the end."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
