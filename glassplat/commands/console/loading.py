"""The second and a half in which PyTorch is imported: once nothing is left to refuse, and with a line that says so."""

from __future__ import annotations

import importlib
import sys
from typing import Any

from rich.console import Console
from rich.control import Control, ControlType

from glassplat.commands.console.messages import message_console

LINE = "loading PyTorch ..."
"""Shown in a terminal only, and gone when the work begins. The cursor stays: Ctrl-C may end the process at once."""


def load(module: str, console: Console | None = None) -> Any:
    """A module of `glassplat` that imports PyTorch, imported now if it is not there yet.

    Args:
        module: its dotted name.
        console: where the line appears; that of standard error if not given.
    """
    console = console or message_console(stderr=True)
    if module in sys.modules or not console.is_terminal:
        return importlib.import_module(module)
    console.print(LINE, end="", highlight=False)
    try:
        return importlib.import_module(module)
    finally:
        console.control(Control(ControlType.CARRIAGE_RETURN, (ControlType.ERASE_IN_LINE, 2)))
