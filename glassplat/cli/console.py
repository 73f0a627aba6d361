"""The console of commands: printed lines, arguments, signals, imports, and how commands end.

Printed text may contain paths and names chosen by others. Rich would interpret `[...]` as markup and `:x:` as an emoji,
and wrap lines at 80 columns in files; control characters would reach the terminal.
"""

from __future__ import annotations

import ctypes
import difflib
import errno
import gc
import importlib
import importlib.metadata
import io
import logging
import os
import platform
import re
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise, takewhile
from shlex import quote
from types import FrameType
from typing import Any, ClassVar, Literal, NamedTuple, NoReturn

from rich.console import Console
from rich.control import Control, ControlType
from rich.text import Text

from glassplat import __version__
from glassplat.errors import InputError, RankLostError, count_noun

UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters other than tabs and line breaks, and undecodable bytes of file names."""


class MessageConsole(Console):
    """A Rich console that lets the command decide how to exit on a broken pipe."""

    def on_broken_pipe(self) -> NoReturn:
        """Re-raises BrokenPipeError."""
        raise BrokenPipeError


def message_console(*, stderr: bool = False) -> Console:
    """Console of a command: prints strings verbatim, and wraps lines only in a terminal."""
    console = MessageConsole(stderr=stderr, markup=False, emoji=False, highlight=False)
    console.soft_wrap = not console.is_terminal
    return console


def shell_word(path: object) -> str:
    """A path quoted for the shell; a leading dash is escaped, so that it is not read as an option."""
    word = str(path)
    return quote(f"./{word}" if word.startswith("-") else word)


def print_line(console: Console, text: object, *, label: str = "", style: str = "") -> None:
    """Prints a line verbatim. The terminal wraps it, so that commands in it can be copied as one line.

    Args:
        console: any console, even one that reads markup.
        text: text of the line.
        label: prefix before a colon, such as `warning`.
        style: colour of the label.
    """
    line = Text(f"{label}:" if label else "", style=style)
    line.append(f"{' ' if label else ''}{printable(str(text))}", style="default")
    console.print(line, soft_wrap=True)


def print_warning(console: Console, text: object) -> None:
    """Prints a warning; the command continues."""
    print_line(console, text, label="warning", style="yellow")


def print_error(label: Literal["error", "stopped", "failed"], text: object) -> None:
    """Prints to standard error why a command, or one of its parts, ends.

    Args:
        label: `error` for wrong input, `stopped` for a failure while running, `failed` for a part that is skipped.
        text: what was expected, what was found, and what to do.
    """
    print_line(message_console(stderr=True), text, label=label, style="red")


def printable(text: str) -> str:
    r"""The text with control characters escaped, such as `\x1b`."""
    return UNPRINTABLE.sub(lambda found: repr(found.group())[1:-1], text)


def make_streams_robust() -> None:
    """Makes output robust: closed streams are replaced, and characters missing from the encoding are escaped."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - Until the process ends.
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def silence_output() -> None:
    """Discards all further output, as on ranks other than the leader, which prints for all."""
    sys.stdout = sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - Until the process ends.


def drop_output() -> None:
    """Discards pending output after a broken pipe."""
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)


class LogPrinter(logging.Handler):
    """Prints log records among the lines of a command, above its progress bar; repeated lines once."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console
        self._shown: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Prints one record unless its line was printed before: planes are fitted twice in a training run."""
        text = record.getMessage()
        if text in self._shown:
            return
        self._shown.add(text)
        if record.levelno >= logging.WARNING:
            print_warning(self._console, text)
        else:
            print_line(self._console, text)


@contextmanager
def print_log_records(console: Console) -> Iterator[None]:
    """Prints log records of the package and warnings of libraries on a console, each as a line."""

    def show(message: Warning | str, *place: Any, **more: Any) -> None:
        print_warning(console, message)

    lines, root = LogPrinter(console), logging.getLogger()
    if not root.handlers:
        root.addHandler(lines)
    logging.getLogger("glassplat").setLevel(logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = show
            yield
    finally:
        root.removeHandler(lines)


SIGNAL_WORDS = {
    name: word
    for name, word in (("SIGINT", "interrupted"), ("SIGTERM", "terminated"), ("SIGHUP", "the terminal was closed"))
    if hasattr(signal, name)  # Windows has no SIGHUP.
}
SIGNAL_CODE_BASE = 128
"""Shells report a process that was killed by a signal as this plus the number of the signal."""


class Interrupted(KeyboardInterrupt):
    """Raised when a signal asks the command to end.

    Attributes:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(SIGNAL_WORDS[signal.Signals(number).name])
        self.number = number


def interrupt_code(stop: KeyboardInterrupt) -> int:
    """Exit code of an interrupt: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP."""
    return SIGNAL_CODE_BASE + (stop.number if isinstance(stop, Interrupted) else signal.SIGINT)


@contextmanager
def raise_on_signals(*, is_program: bool = False) -> Iterator[list[Interrupted]]:
    """Turns signals into `Interrupted` exceptions, so that half-written files are removed.

    Yields the list of those raised, because an interrupted library may fail with an error of its own. If the process
    ends after the command, a later signal kills it at once, without a traceback of the cleanup.
    """
    raised: list[Interrupted] = []

    def stop(number: int, frame: FrameType | None) -> None:
        raised.append(Interrupted(number))
        raise raised[-1]

    with _install_handlers(stop, handler_after=signal.SIG_DFL if is_program else None):
        yield raised


@contextmanager
def exit_on_signals() -> Iterator[None]:
    """Ends the process with one line at the first signal, while libraries are being imported.

    Nothing has been written yet that would need cleanup. An exception would not work: a library may treat it as its
    own failure, or continue without the module that it was importing.
    """

    def end(number: int, frame: FrameType | None) -> None:
        stop = Interrupted(number)
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, f"{stop}\n".encode())
        os._exit(interrupt_code(stop))

    with _install_handlers(end):
        yield


@contextmanager
def defer_signals() -> Iterator[None]:
    """Defers signals to the end of the context, for imports while something runs that needs an orderly shutdown."""
    held: list[int] = []
    with _install_handlers(lambda number, frame: held.append(number)):
        yield
    for number in held[:1]:
        signal.raise_signal(number)


@contextmanager
def _install_handlers(handler_within: signal._HANDLER, handler_after: signal._HANDLER | None = None) -> Iterator[None]:
    """Installs signal handlers, except for signals that the process ignores, as under `nohup`.

    Args:
        handler_within: handler in this context.
        handler_after: handler after it; the previous one if None.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # Only the main thread can install handlers.
        return
    numbers = [getattr(signal, name) for name in SIGNAL_WORDS]
    before = {number: signal.getsignal(number) for number in numbers}
    handled = [number for number, handler in before.items() if handler not in (signal.SIG_IGN, None)]
    for number in handled:
        signal.signal(number, handler_within)
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, before[number] if handler_after is None else handler_after)


BAD_INPUT_CODE, FAILURE_CODE = 2, 1
BAD_INPUT_ERRORS = ("glassplat.panes.PlaneFitError", "glassplat.kernels.backend.devices.CudaUnavailableError")
EXPECTED_FAILURES = ("glassplat.training.loop.TrainingDivergedError",)
GPU_OUT_OF_MEMORY = ("torch.OutOfMemoryError",)
"""By name, because this module is loaded before PyTorch, and even if PyTorch cannot be loaded."""
BAD_PATH = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
BAD_PATH_NUMBERS = (errno.ENAMETOOLONG, errno.ELOOP, errno.EROFS, errno.EINVAL)
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
OUT_OF_MEMORY = (
    "can't allocate memory",
    "Cannot allocate memory",
    "not enough memory",
    "bad_alloc",
    "bad allocation",
    "failed to map segment",
)
LONGEST_QUOTE = 300
MEMORY_REMEDY = "smaller photographs (a larger --downscale in training) or fewer Gaussians need less"


class Ending(NamedTuple):
    """Message and exit code of a failed command: `error` for wrong input, `stopped` for a failure."""

    label: Literal["error", "stopped"]
    text: str
    code: int


def classify_error(error: BaseException) -> Ending:
    """Message and exit code for an error; the traceback of an unexpected one is saved to a file."""
    if isinstance(error, RankLostError):
        reported = error.ending or ("stopped", str(error), FAILURE_CODE)
        return Ending("error" if reported[0] == "error" else "stopped", *reported[1:])
    if isinstance(error, InputError) or is_one_of(error, BAD_INPUT_ERRORS):
        return Ending("error", str(error), BAD_INPUT_CODE)
    if isinstance(error, OSError):
        bad_path = isinstance(error, BAD_PATH) or error.errno in BAD_PATH_NUMBERS
        label: Literal["error", "stopped"] = "error" if bad_path else "stopped"
        return Ending(label, describe_os_error(error), BAD_INPUT_CODE if bad_path else FAILURE_CODE)
    return Ending("stopped", _describe_failure(error), FAILURE_CODE)


def is_one_of(error: BaseException, names: tuple[str, ...]) -> bool:
    """Return whether an error is an instance of one of the named classes; those of unloaded modules cannot be."""
    for module, _, name in (full.rpartition(".") for full in names):
        kind = getattr(sys.modules.get(module), name, None)
        if kind is not None and isinstance(error, kind):
            return True
    return False


def describe_os_error(error: OSError) -> str:
    """An operating-system error in words: the path, the problem and the remedy."""
    if error.errno is None or error.strerror is None:
        return str(error)  # One of ours, with a complete message.
    subjects = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    about = f"{' -> '.join(subjects)}: " if subjects else ""
    remedy = "; free some space" if error.errno in DISK_FULL else ""
    return f"{about}{error.strerror[:1].lower()}{error.strerror[1:]}{remedy}"


def _describe_failure(error: BaseException) -> str:
    if is_one_of(error, EXPECTED_FAILURES):
        return str(error)
    if is_one_of(error, GPU_OUT_OF_MEMORY):
        return f"{first_sentence(error)}; {MEMORY_REMEDY}, or use --device cpu"
    if is_out_of_memory(error):
        reason = first_sentence(error, OUT_OF_MEMORY) or "an allocation failed"
        return f"out of memory ({reason}); {MEMORY_REMEDY}"
    sentence = first_sentence(error)
    return f"unexpected error, {type(error).__name__}: {sentence}; {save_traceback(error)}"


def is_shortage(error: BaseException) -> bool:
    """Return whether memory or disk space ran out, so that the command may succeed another time."""
    is_full = isinstance(error, OSError) and error.errno in DISK_FULL
    return is_full or is_one_of(error, GPU_OUT_OF_MEMORY) or is_out_of_memory(error)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error means that memory ran out; many libraries say so only in the message."""
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, RuntimeError | ImportError | OSError) and any(text in str(error) for text in OUT_OF_MEMORY):
        return True
    return error.__cause__ is not None and is_out_of_memory(error.__cause__)


def first_sentence(error: BaseException, words: tuple[str, ...] = ()) -> str:
    """First sentence of a library's message, which may have many lines; preferably one with any of the words."""
    sentences = (str(error).strip().splitlines() or [""])[0].split(". ")
    first = next((one for one in sentences if any(word in one for word in words)), sentences[0]).rstrip(".")
    return first if len(first) <= LONGEST_QUOTE else f"{first[:LONGEST_QUOTE]} ..."


def save_traceback(error: BaseException) -> str:
    """Writes the traceback to a temporary file; returns its location, or that of the error if this fails."""
    trace = "".join(traceback.format_exception(error))
    head = f"{versions()}\n{time.strftime('%Y-%m-%d %H:%M:%S %z')}\n{sys.argv}\n\n"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="glassplat-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write(head + trace)
    except OSError:
        frames = traceback.extract_tb(error.__traceback__)
        return f"raised in {frames[-1].filename}, line {frames[-1].lineno}" if frames else "at an unknown location"
    return f"the traceback is in {file.name}. Please report it, and how it came about"


def versions() -> str:
    """Versions of the package, its main dependencies, the system and the GPU in one line, without imports."""
    return (
        f"glassplat {__version__}, Python {platform.python_version()}, PyTorch {_package_version('torch')}, "
        f"Numba {_package_version('numba')}, {platform.system()} {platform.release()} {platform.machine()}, "
        f"{os.cpu_count()} CPU cores, {_gpu_name()}"
    )


def _package_version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def _gpu_name() -> str:
    """The first NVIDIA GPU of the driver."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return "no NVIDIA driver"
    name, version = ctypes.create_string_buffer(256), ctypes.c_int()
    if driver.cuInit(0) or driver.cuDeviceGetName(name, 256, 0) or driver.cuDriverGetVersion(ctypes.byref(version)):
        return "an NVIDIA driver without a GPU"
    return f"{name.value.decode(errors='replace')} (CUDA {version.value // 1000}.{version.value % 1000 // 10})"


def check_arguments(arguments: Sequence[str]) -> None:
    """Refuses empty arguments: an empty path would mean the current folder."""
    for before, argument in pairwise(arguments):
        option, is_joined, value = argument.partition("=")
        if argument == "" or (option.startswith("--") and is_joined and not value):
            name = option or before
            raise InputError(f"the value of {name} is empty (an unset shell variable?); expected a value")


def closest_words(word: str, known: Iterable[str], cutoff: float = 0.6) -> list[str]:
    """The known word closest to a mistyped one, if any is close."""
    return difflib.get_close_matches(word, list(known), n=1, cutoff=cutoff)


def unknown_name_message(what: str, word: str, known: Iterable[str], command: str) -> str:
    """Message about an unknown command or method, with the closest one, all of them, and their help."""
    meant = closest_words(word, known)
    guess = f"did you mean {meant[0]}? There are" if meant else "expected one of"
    wrong = f"there is no {what} {word!r}" if word else f"a {what} is missing"
    return f"{wrong}; {guess} {', '.join(known)}: see {command}"


BOX_DRAWING = re.compile(r"\x1b\[[0-9;]*m|[│─╭╮╰╯]|-{5,}")
"""Frames and colours of tyro's messages."""
NUMBERS = {"INT": "whole number", "FLOAT": "number"}
"""Plain words for tyro's type names."""
NOT_A_NUMBER = re.compile(
    r"Error parsing (--[\w./-]+):.*Argument helptext:[ \n]+--[\w., -]+? ((?:INT|FLOAT|None|[|{} ])+)"
)


def tyro_error_line(output: str) -> str:
    """tyro's error message as one line, without its box, title and pointer to the help."""
    title, _, text = BOX_DRAWING.sub("", output).strip().partition("\n")
    text = " ".join(text.partition("For full helptext")[0].split()).removeprefix("Error parsing ")
    text = re.sub(r"\.? \(required\)", ";", text).rstrip(".;")
    return f"{text[:1].lower()}{text[1:]}" or title.strip()


def wrong_number_message(output: str, arguments: Sequence[str]) -> str | None:
    """A message on a wrong number that replaces tyro's: expected and given values; None for other errors."""
    if (found := NOT_A_NUMBER.search(" ".join(BOX_DRAWING.sub("", output).split()))) is None:
        return None
    names = found[1].split("/")
    place = max((at for at, word in enumerate(arguments) if word.partition("=")[0] in names), default=-1)
    option, _, value = arguments[place].partition("=") if place >= 0 else (names[0], "", "")
    given = [value] if value else list(takewhile(lambda word: not word.startswith("--"), arguments[place + 1 :]))
    expected = " or ".join(describe_number_types(types.strip("{} ")) for types in found[2].split("|"))
    return f"{option}: expected {expected}, not {' '.join(given)!r}"


def describe_number_types(types: str) -> str:
    """An option's value types in words, as in "3 numbers" for "FLOAT FLOAT FLOAT"."""
    kinds = types.split()
    word = NUMBERS.get(kinds[0])
    return types if word is None else f"a {word}" if len(kinds) == 1 else count_noun(len(kinds), word)


LOADING_LINE = "loading PyTorch ..."
"""Shown in terminals only, until the import ends. The cursor is not hidden: Ctrl-C may end the process at once."""


def import_pytorch_module(module: str) -> Any:
    """Imports a module that needs PyTorch, by its dotted name.

    A terminal shows a line meanwhile. Garbage collection is off, and exempts the imported objects afterwards.
    """
    console, is_collecting = message_console(stderr=True), gc.isenabled()
    is_shown = module not in sys.modules and console.is_interactive
    if is_shown:
        console.print(LOADING_LINE, end="", highlight=False)
    if is_collecting:
        gc.disable()
    try:
        return importlib.import_module(module)
    finally:
        if is_collecting:
            gc.freeze()
            gc.enable()
        if is_shown:
            console.control(Control(ControlType.CARRIAGE_RETURN, (ControlType.ERASE_IN_LINE, 2)))


def import_uninterrupted(module: str) -> Any:
    """The same with signals deferred, for imports during work, which must not be interrupted."""
    with defer_signals():
        return import_pytorch_module(module)


class Command:
    """Base of the commands whose work is a function `(command, console)` of a module that imports PyTorch.

    Attributes:
        entry_point: the module in `glassplat.cli`, and the function.
        interrupt_hint: state on disk after an interrupt, and how to continue; fields of the command are in braces.
    """

    entry_point: ClassVar[str]
    interrupt_hint: ClassVar[str]

    def check(self) -> None:
        """Checks options and paths."""
        raise NotImplementedError

    def set_up(self) -> None:
        """Checks options and paths, and imports the module that does the work."""
        self.check()
        import_pytorch_module(f"glassplat.cli.{self.entry_point.partition(':')[0]}")

    def run(self, console: Console) -> None:
        """Does the work."""
        module, _, function = self.entry_point.partition(":")
        getattr(importlib.import_module(f"glassplat.cli.{module}"), function)(self, console)

    def interrupt_message(self) -> str:
        """Message after an interrupt: the state on disk, and how to continue."""
        return self.interrupt_hint.format(**vars(self))
