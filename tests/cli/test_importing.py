"""The line shown while PyTorch is imported, and cases without it."""

from __future__ import annotations

import gc
import io
import sys
from collections.abc import Callable

import pytest
from rich.console import Console

from glassplat.cli.console import LOADING_LINE, import_pytorch_module

MODULE = "glassplat.cli.progress"


def terminal(kind: str = "xterm") -> Console:
    return Console(file=io.StringIO(), force_terminal=True, legacy_windows=False, _environ={"TERM": kind})


def standard_error(monkeypatch: pytest.MonkeyPatch, console: Console) -> Console:
    """Redirects output for standard error to the console, and returns it."""
    monkeypatch.setattr("glassplat.cli.console.message_console", lambda *, stderr: console)
    return console


def shown(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_terminal_shows_a_transient_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    console = standard_error(monkeypatch, terminal())
    assert import_pytorch_module(MODULE).__name__ == MODULE
    assert shown(console) == f"{LOADING_LINE}\r\x1b[2K"


def test_existing_kernels_are_not_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    console = standard_error(monkeypatch, terminal())
    assert import_pytorch_module("glassplat.cli.console").LOADING_LINE is LOADING_LINE
    assert shown(console) == ""


@pytest.mark.parametrize("make", [lambda: Console(file=io.StringIO()), lambda: terminal("dumb")])
def test_a_file_or_a_dumb_terminal_gets_no_transient_line(
    make: Callable[[], Console], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    console = standard_error(monkeypatch, make())
    import_pytorch_module(MODULE)
    assert shown(console) == ""


def test_the_progress_line_is_erased_before_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    console = standard_error(monkeypatch, terminal())
    with pytest.raises(ModuleNotFoundError):
        import_pytorch_module("glassplat.no_such_module")
    assert shown(console).endswith("\x1b[2K")


@pytest.mark.parametrize("enabled", [True, False])
def test_garbage_is_collected_afterwards_as_before(enabled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gc, "isenabled", lambda: enabled)
    asked: list[str] = []
    for name in ("disable", "freeze", "enable"):
        monkeypatch.setattr(gc, name, lambda name=name: asked.append(name))
    with pytest.raises(ModuleNotFoundError):
        import_pytorch_module("glassplat.no_such_module")
    assert asked == (["disable", "freeze", "enable"] if enabled else [])
