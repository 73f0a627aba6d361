"""Ctrl-C, termination and closing terminals at any moment of a command: one line, and no half-written files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from glassplat.cli.capture import Annotate
from glassplat.cli.console import Interrupted, defer_signals, raise_on_signals
from glassplat.cli.main import main
from glassplat.cli.scene import Clean, Dereflect, Evaluate, Render
from glassplat.cli.train import SCENE, Demo, Train
from glassplat.files.writing import atomic_write
from glassplat.methods.splat_recipe import SplatRecipe
from tests.annotate.conftest import marked_document

SIGNALLED_WHILE_IMPORTING = """
import importlib.abc, os, signal, sys

class Sender(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {name!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.{signal})
        return None

sys.meta_path.insert(0, Sender())
sys.argv = ["glassplat", *{arguments!r}]
from glassplat.cli.main import main
sys.exit(main())
"""
SIGNALLED_AT_THE_END = """
import atexit, os, signal, sys

atexit.register(os.kill, os.getpid(), signal.SIGINT)
sys.argv = ["glassplat", "--version"]
from glassplat.cli.main import main
sys.exit(main())
"""
PYCOLMAP_TERMINATED = """
import os, signal, time
from glassplat.captures.colmap_library import pycolmap
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(60)
"""
CODES = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129}
WORDS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "the terminal was closed"}


def ended(script: str) -> tuple[int, str, str]:
    """Exit code, output and errors of a script in a separate process."""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=100)
    return done.returncode, done.stdout, done.stderr


def test_signals_that_are_held_are_answered_afterwards() -> None:
    done: list[str] = []
    with raise_on_signals() as raised, pytest.raises(Interrupted, match="terminated"):
        with defer_signals():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)
            done.append("what must not break off")
        done.append("what comes after it")
    assert done == ["what must not break off"] and len(raised) == 1


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("glassplat.cli.console", "SIGINT"),
        ("tyro", "SIGINT"),
        ("torch._C", "SIGINT"),
        ("numba.core", "SIGINT"),
        ("glassplat.training.actions", "SIGTERM"),
    ],
)
def test_a_signal_among_the_imports_is_one_line(name: str, number: str, tmp_path: Path) -> None:
    arguments = ["train", "splat", "--data", str(SCENE), "--output", str(tmp_path / "run")]
    code, _, said = ended(SIGNALLED_WHILE_IMPORTING.format(name=name, signal=number, arguments=arguments))
    assert (code, said) == (CODES[number], f"{WORDS[number]}\n")
    assert not (tmp_path / "run").exists()


def test_a_signal_among_the_imports_of_a_command_at_work_is_one_line() -> None:
    script = SIGNALLED_WHILE_IMPORTING.format(name="torch._C", signal="SIGTERM", arguments=["info", str(SCENE)])
    code, out, said = ended(f"import atexit\natexit.register(print, 'cleanup')\n{script}")
    assert (code, said) == (CODES["SIGTERM"], "terminated; nothing was changed\n") and "a capture" in out
    assert "cleanup" not in out  # A thread of COLMAP that is still at work would abort in it.


def test_a_signal_after_the_command_ends_the_process_without_a_traceback() -> None:
    """For example, the second of two Ctrl-C, while libraries clean up."""
    code, out, said = ended(SIGNALLED_AT_THE_END)
    assert (code, said) == (-signal.SIGINT, "") and out.startswith("glassplat ")


def test_loading_pycolmap_leaves_termination_as_it_was() -> None:
    assert ended(PYCOLMAP_TERMINATED) == (-signal.SIGTERM, "", "")


def test_pycolmap_can_be_loaded_in_another_thread() -> None:
    script = "import threading\n\ndef load():\n    from glassplat.captures import colmap_library\n"
    script += "    colmap_library.pycolmap\n    print('loaded')\n\n"
    assert ended(script + "worker = threading.Thread(target=load)\nworker.start()\nworker.join()")[1] == "loaded\n"


@pytest.mark.parametrize("number", CODES)
def test_a_signal_reports_the_saved_state_and_removes_partial_files(
    number: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def work(self: Evaluate, console: object) -> None:
        with atomic_write(tmp_path / "results.json") as temporary:
            temporary.write_text("half")
            os.kill(os.getpid(), getattr(signal, number))
            time.sleep(10)

    before = [signal.getsignal(getattr(signal, name)) for name in CODES]
    monkeypatch.setattr(Evaluate, "set_up", lambda self: None)
    monkeypatch.setattr(Evaluate, "run", work)
    assert main(["eval", "my_run"]) == CODES[number]
    said = capsys.readouterr().err
    assert said.startswith(f"{WORDS[number]}; my_run itself is unchanged") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())
    assert [signal.getsignal(getattr(signal, name)) for name in CODES] == before


def test_an_interrupt_that_a_library_disguises_is_still_an_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(self: Evaluate, console: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        except KeyboardInterrupt as stop:
            raise ImportError("Cannot import the C++ backend") from stop

    monkeypatch.setattr(Evaluate, "set_up", lambda self: None)
    monkeypatch.setattr(Evaluate, "run", work)
    assert main(["eval", "my_run"]) == 130
    assert capsys.readouterr().err.startswith("interrupted; ")


def test_an_ignored_signal_stays_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    # As `nohup` does with SIGHUP, and a shell with Ctrl-C for background processes.
    def work(self: Evaluate, console: object) -> None:
        for name in ("SIGHUP", "SIGINT"):
            os.kill(os.getpid(), getattr(signal, name))
        time.sleep(0.01)

    monkeypatch.setattr(Evaluate, "set_up", lambda self: None)
    monkeypatch.setattr(Evaluate, "run", work)
    before = {name: signal.signal(getattr(signal, name), signal.SIG_IGN) for name in ("SIGHUP", "SIGINT")}
    try:
        assert main(["eval", "my_run"]) == 0
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)


def test_a_command_can_run_in_another_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    codes: list[int] = []
    monkeypatch.setattr(Evaluate, "set_up", lambda self: None)
    monkeypatch.setattr(Evaluate, "run", lambda self, console: None)
    worker = threading.Thread(target=lambda: codes.append(main(["eval", "my_run"])))
    worker.start()
    worker.join()
    assert codes == [0]


def test_interrupt_messages_name_the_output_and_how_to_continue(tmp_path: Path) -> None:
    run, output = tmp_path / "run", tmp_path / "output"
    train = Train(SplatRecipe(), tmp_path, run)
    commands = [
        train,
        Evaluate(run),
        Render(run, output),
        Dereflect(run, output),
        Demo(output),
    ]
    said = [command.interrupt_message() for command in commands]
    assert all("repeat the command" in text for text in said)
    assert [str(run) in text or str(output) in text for text in said] == [False, True, True, True, True]
    assert "no checkpoint was written yet" in said[0] and "--resume" not in said[0]
    run.mkdir()
    train_checkpoint = run / "checkpoint.safetensors"
    train_checkpoint.write_bytes(b"")
    assert "--resume" in train.interrupt_message()


def test_interrupt_messages_speak_only_of_what_is_there(tmp_path: Path) -> None:
    clean, output = Clean(tmp_path / "run", tmp_path / "clean"), tmp_path / "clean"
    assert clean.interrupt_message() == f"{tmp_path / 'run'} is as it was; repeat the command"
    output.mkdir()
    assert clean.interrupt_message() == f"{tmp_path / 'run'} is as it was; remove {output} and repeat the command"
    annotate, marks = Annotate(tmp_path), tmp_path / "annotations.json"
    assert annotate.interrupt_message().startswith(f"no pane of {tmp_path} is marked yet: repeat the command")
    marks.write_text(json.dumps({"version": 1, "panes": []}))
    assert annotate.interrupt_message().startswith("no pane of ")
    for written in (json.dumps(marked_document()), "{"):
        marks.write_text(written)
        assert annotate.interrupt_message() == f"the marks are saved in {marks}: repeat the command to continue"
