"""Lines printed by commands, with names chosen by others."""

from __future__ import annotations

import io
import logging
import warnings

import pytest
from rich.console import Console
from rich.table import Table

from glassplat.cli.console import (
    message_console,
    print_error,
    print_line,
    print_log_records,
    print_warning,
    printable,
    shell_word,
)

AWKWARD = [
    "/data/[bold]/run",
    "/data/[/bold]/run",
    "/data/[/]/run",
    "/data/[red]x[/red]",
    "[nan, 1.0, nan]",
    "/a:smile:b/:x:",
    "trailing\\",
    "\\[escaped]",
    "[link=file:///etc]x[/link]",
    "/long/" + "path " * 40 + "end",
    "/long/" + "path" * 60,
    "",
]


@pytest.mark.parametrize("text", AWKWARD)
def test_names_are_shown_as_they_are(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    print_error("error", text)
    assert capsys.readouterr().err == f"error: {text}\n"
    print_warning(message_console(), text)
    print_line(message_console(), text)
    message_console().print(text)
    assert capsys.readouterr().out == f"warning: {text}\n{text}\n{text}\n"
    any_console = Console(file=io.StringIO())
    print_line(any_console, text)
    assert any_console.file.getvalue() == f"{text}\n"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a\x1b[31mb", r"a\x1b[31mb"),
        ("a\x07\x9bb\x7f", r"a\x07\x9bb\x7f"),
        ("caf\udce9", r"caf\udce9"),
        ("two\nlines\tand a tab", "two\nlines\tand a tab"),
        ("größer ± 1°", "größer ± 1°"),
    ],
)
def test_control_characters_are_escaped(text: str, shown: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert printable(text) == shown
    print_error("stopped", text)
    assert "".join(capsys.readouterr().err.split()) == "".join(f"stopped: {shown}".split())


def test_a_terminal_breaks_lines_itself() -> None:
    terminal = Console(file=io.StringIO(), force_terminal=True, color_system=None, width=20)
    command = "next: glassplat train planar --data /a/rather/long/path --output somewhere"
    print_line(terminal, command)
    assert terminal.file.getvalue() == command + "\n"


def test_a_path_with_a_leading_dash_is_no_option() -> None:
    assert [shell_word(path) for path in ("-run", "a run", "run-1")] == ["./-run", "'a run'", "run-1"]


def test_tables_show_names_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("metric", "[bold]")
    table.add_row("[/x]", ":smile:")
    message_console().print(table)
    shown = capsys.readouterr().out
    assert all(name in shown for name in ("[bold]", "[/x]", ":smile:"))


def test_each_log_message_and_warning_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    monkeypatch.setattr(logging.getLogger(), "level", logging.WARNING)
    package, library = logging.getLogger("glassplat.kernels"), logging.getLogger("somebody.else")
    with print_log_records(message_console()):
        package.info("compiling [bold] for %s", "this :x: machine")
        package.warning("cannot keep [/x]")
        library.info("chatter")
        library.warning("beware")
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.warn("an image of [127] megapixels", stacklevel=1)
    assert capsys.readouterr().out.splitlines() == [
        "compiling [bold] for this :x: machine",
        "warning: cannot keep [/x]",
        "warning: beware",
        "warning: an image of [127] megapixels",
    ]


def test_a_command_prints_a_repeated_line_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    panes = logging.getLogger("glassplat.panes")
    for _ in range(2):
        with print_log_records(message_console()):
            panes.warning("pane %d: may be off", 1)
            panes.warning("pane %d: may be off", 2)
            panes.warning("pane %d: may be off", 1)
    assert capsys.readouterr().out.splitlines() == 2 * ["warning: pane 1: may be off", "warning: pane 2: may be off"]
    assert not logging.getLogger().handlers
