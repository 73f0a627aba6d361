"""Exit of commands: one readable message and an exit code for every exception."""

from __future__ import annotations

import errno
import json
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from glassplat.cli.console import LONGEST_QUOTE
from glassplat.cli.main import main
from glassplat.cli.scene import Evaluate
from glassplat.cli.train import Train
from glassplat.errors import InputError
from glassplat.kernels.backend.devices import CudaUnavailableError
from glassplat.panes import PlaneFitError
from glassplat.training.loop import TrainingDivergedError


class PanicException(BaseException):
    """The exception of libraries in Rust, which is not an `Exception`."""


def endless(number: int) -> int:
    return endless(number + 1) + 1


def too_large_for_numpy() -> None:
    np.empty(10**17)


def too_large_for_torch() -> None:
    torch.empty(10**16)


def library_without_memory() -> None:
    try:
        raise ImportError("_core.so: failed to map segment from shared object")
    except ImportError as error:
        raise RuntimeError("Cannot import the C++ backend") from error


def too_deep() -> None:
    endless(0)


def too_deep_json() -> None:
    json.loads("[" * 100_000)


def too_long_name() -> None:
    Path("x" * 5000).read_text()


def folder_as_file() -> None:
    Path("/").read_text()


def file_as_folder() -> None:
    Path("/dev/null/file").read_text()


def no_such_file() -> None:
    Path("/no/such/[bold]file").read_text()


def raising(error: BaseException) -> Callable[[], None]:
    def work() -> None:
        raise error

    work.__name__ = f"{type(error).__name__} {error}"
    return work


BAD_INPUT = [
    (raising(InputError("expected [1, 2], got [/]; do [bold]this")), ["expected [1, 2], got [/]; do [bold]this"]),
    (raising(PlaneFitError("no plane in [pane]")), ["no plane in [pane]"]),
    (raising(CudaUnavailableError("no GPU; use --device cpu")), ["no GPU; use --device cpu"]),
    (raising(FileNotFoundError("no folder x; expected a capture")), ["no folder x; expected a capture"]),
    (no_such_file, ["/no/such/[bold]file: no such file or directory"]),
    (file_as_folder, ["/dev/null/file: not a directory"]),
    (folder_as_file, ["/: is a directory"]),
    (too_long_name, ["file name too long"]),
    (raising(PermissionError(errno.EACCES, "Permission denied", "/a/b")), ["/a/b: permission denied"]),
    (raising(OSError(errno.EROFS, "Read-only file system", "/a/b")), ["/a/b: read-only file system"]),
    (raising(OSError(errno.ELOOP, "Too many levels of symbolic links", "/a")), ["/a: too many levels"]),
]
FAILURES = [
    (raising(TrainingDivergedError("loss term 'l1' is nan")), ["loss term 'l1' is nan"]),
    (raising(OSError(errno.ENOSPC, "No space left on device", "/a/b")), ["/a/b: no space left on device; free some"]),
    (raising(OSError(errno.EIO, "Input/output error")), ["input/output error"]),
    (raising(torch.OutOfMemoryError("CUDA out of memory. Tried 2 GiB.\nMore")), ["CUDA out of memory;", "--device"]),
    (too_large_for_torch, ["out of memory (DefaultCPUAllocator: ", " tried to allocate ", "--downscale"]),
    (too_large_for_numpy, ["out of memory", "--downscale"]),
    (raising(MemoryError()), ["out of memory", "--downscale"]),
    (library_without_memory, ["out of memory"]),
    (raising(ImportError("libtorch_cpu.so: failed to map segment from shared object")), ["out of memory"]),
]
UNFORESEEN = [
    (too_deep, "RecursionError"),
    (too_deep_json, "RecursionError"),
    (raising(KeyError("[bold]")), "KeyError: '[bold]'"),
    (raising(ValueError("many\nlines\nof it")), "ValueError: many;"),
    (raising(RuntimeError("x" * 10_000)), "RuntimeError: " + "x" * LONGEST_QUOTE + " ...;"),
    (raising(RuntimeError()), "RuntimeError: ;"),
    (raising(AssertionError("surrogate \udcff")), r"AssertionError: surrogate \udcff;"),
    (raising(PanicException("a library in Rust")), "PanicException: a library in Rust;"),
    (raising(ImportError("libcudart.so: cannot open shared object file")), "ImportError: libcudart.so"),
]
NAME = re.compile(r"the traceback is in (\S+\.log)\. Please report it")


def ended(work: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> int:
    """The exit code of a command that does the given work."""
    monkeypatch.setattr(Evaluate, "set_up", lambda self: None)
    monkeypatch.setattr(Evaluate, "run", lambda self, console: work())
    return main(["eval", "run"])


@pytest.mark.parametrize(("work", "words"), BAD_INPUT, ids=lambda value: getattr(value, "__name__", None))
def test_bad_input_is_explained_with_code_2(
    work: Callable[[], None], words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ended(work, monkeypatch) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1
    assert all(word in said for word in words)


@pytest.mark.parametrize(("work", "words"), FAILURES, ids=lambda value: getattr(value, "__name__", None))
def test_a_failure_is_explained_with_code_1(
    work: Callable[[], None], words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ended(work, monkeypatch) == 1
    said = capsys.readouterr().err
    assert said.startswith("stopped: ") and said.count("\n") == 1
    assert all(word in said for word in words)
    assert "unexpected error" not in said


@pytest.mark.parametrize("work", [too_large_for_numpy, raising(OSError(errno.ENOSPC, "No space left on device"))])
@pytest.mark.parametrize("is_saved", [False, True], ids=["nothing saved", "checkpoint"])
def test_a_training_that_runs_out_of_room_says_what_is_left(
    work: Callable[[], None],
    is_saved: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(Train, "set_up", lambda self: None)
    monkeypatch.setattr(Train, "run", lambda self, console: work())
    if is_saved:
        (tmp_path / "checkpoint.safetensors").touch()
    assert main(["train", "splat", "--data", "capture", "--output", str(tmp_path)]) == 1
    nothing = "no checkpoint was written yet: repeat the command to start again"
    saved = f"{tmp_path} holds a checkpoint: repeat the command with --resume to continue from it"
    said = capsys.readouterr().err
    assert said.endswith(f"; {saved if is_saved else nothing}\n")
    assert said.count("checkpoint") == 1


@pytest.mark.parametrize(("work", "words"), UNFORESEEN, ids=lambda value: getattr(value, "__name__", None))
def test_unexpected_errors_end_with_one_line_and_a_traceback_file(
    work: Callable[[], None],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert ended(work, monkeypatch) == 1
    said = capsys.readouterr().err
    assert said.startswith("stopped: unexpected error, ") and said.count("\n") == 1
    assert words in said
    found = NAME.search(said)
    assert found is not None
    assert [Path(found[1])] == list(tmp_path.iterdir())
    saved = Path(found[1]).read_text(encoding="utf-8")
    assert "Traceback (most recent call last)" in saved and "glassplat 0" in saved and "PyTorch" in saved
    assert len(saved) < 100_000


def test_an_unexpected_error_names_its_location_if_no_file_can_be_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null")
    assert ended(raising(KeyError("x")), monkeypatch) == 1
    said = capsys.readouterr().err
    assert re.search(r"raised in \S*test_exit_codes.py, line \d+\n$", said) and said.count("\n") == 1


def test_a_failing_crash_report_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_memory(error: BaseException) -> None:
        raise MemoryError

    monkeypatch.setattr("glassplat.cli.console.classify_error", no_memory)
    assert ended(raising(KeyError("x")), monkeypatch) == 1
    assert capsys.readouterr().err == "stopped: out of memory\n"


def test_a_library_that_cannot_be_loaded_ends_with_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def broken(name: str) -> type:
        raise OSError("libtorch_cpu.so: cannot enable executable stack")

    monkeypatch.setattr("glassplat.cli.main.command_class", broken)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert main(["eval", "run"]) == 1
    assert capsys.readouterr().err == "stopped: libtorch_cpu.so: cannot enable executable stack\n"


def test_the_listed_errors_are_those_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    # They are listed by name to avoid imports; a renamed class would be treated as unexpected.
    from glassplat.cli.console import BAD_INPUT_ERRORS as BAD
    from glassplat.cli.console import EXPECTED_FAILURES as FAILED
    from glassplat.cli.console import GPU_OUT_OF_MEMORY

    kinds = (PlaneFitError, CudaUnavailableError, TrainingDivergedError)
    assert [*BAD, *FAILED] == [f"{kind.__module__}.{kind.__qualname__}" for kind in kinds]
    assert hasattr(torch, GPU_OUT_OF_MEMORY[0].rpartition(".")[2])


@pytest.mark.parametrize(
    ("raised", "expected"), [(None, 0), (SystemExit(2), 2), (InputError("x"), 2), (KeyboardInterrupt(), 130)]
)
def test_a_rank_ends_at_once_in_every_case(
    raised: BaseException | None, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(command: object) -> None:
        if raised is not None:
            raise raised

    def leave(code: int) -> None:
        raise LeftError(code)

    monkeypatch.setattr("glassplat.cli.main.prepare_command", lambda arguments: None)
    monkeypatch.setattr("glassplat.cli.main.run", run)
    monkeypatch.setattr("glassplat.training.ranks.exit_at_once", leave)
    monkeypatch.setattr("glassplat.cli.main.report_interrupt", lambda stop, command: 130)
    monkeypatch.setattr("sys.argv", ["glassplat", "info"])
    with pytest.raises(LeftError) as left:
        main()
    assert left.value.args == (expected,)


class LeftError(BaseException):
    """Stands for the immediate end of the process, without Python's own clean-up."""
