"""The console of commands: printed lines, arguments, signals, imports, and how commands end.

Everything printed may hold a path or a name that somebody else chose. Rich would read `[...]` in it as markup and `:x:`
as a picture, and break it at 80 columns where the output goes to a file; a control character would reach the terminal.
"""

from __future__ import annotations

import ctypes
import difflib
import errno
import gc
import importlib
import importlib.metadata
import io
import itertools
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
from shlex import quote
from types import FrameType
from typing import Any, ClassVar, Literal, NamedTuple, NoReturn

from rich.console import Console
from rich.control import Control, ControlType
from rich.text import Text

from glassplat import __version__
from glassplat.errors import InputError, RankLostError

UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters but for tabs and line breaks, and the bytes of a file name that are not text."""


class MessageConsole(Console):
    """Rich's console; it leaves it to the command how to end when nobody reads the output any more."""

    def on_broken_pipe(self) -> NoReturn:
        """Raises BrokenPipeError again."""
        raise BrokenPipeError


def message_console(*, stderr: bool = False) -> Console:
    """The console of a command: strings are shown as they are, and break only in a terminal."""
    console = MessageConsole(stderr=stderr, markup=False, emoji=False, highlight=False)
    console.soft_wrap = not console.is_terminal
    return console


def shell_word(path: object) -> str:
    """A path as it is typed in a command, where a leading dash would begin an option."""
    word = str(path)
    return quote(f"./{word}" if word.startswith("-") else word)


def count_noun(number: int, noun: str) -> str:
    """A number of things, as in "1 pane" and "2 panes"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def say(console: Console, text: object, *, label: str = "", style: str = "") -> None:
    """Prints a line as it is; a terminal breaks it, so that a command in it is copied as one line.

    Args:
        console: where to; any console, also one that reads markup.
        text: what to say.
        label: a word in front, followed by a colon, such as `warning`.
        style: the label's colour.
    """
    line = Text(f"{label}:" if label else "", style=style)
    line.append(f"{' ' if label else ''}{printable(str(text))}", style="default")
    console.print(line, soft_wrap=True)


def warn(console: Console, text: object) -> None:
    """Prints a warning: the command goes on."""
    say(console, text, label="warning", style="yellow")


def complain(label: Literal["error", "stopped", "failed"], text: object) -> None:
    """Prints on standard error why a command ends, or one of its parts.

    Args:
        label: `error` for wrong input, `stopped` for a failure while running, `failed` for a part that is left out.
        text: what was expected, what came, and what to do.
    """
    say(message_console(stderr=True), text, label=label, style="red")


def printable(text: str) -> str:
    r"""The text with what no terminal should get written out, such as `\x1b`."""
    return UNPRINTABLE.sub(lambda found: repr(found.group())[1:-1], text)


def plain_streams() -> None:
    """Lets every program be started from: with output that is closed, or in an encoding that lacks a character."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - Until the process ends.
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def silence() -> None:
    """Says nothing from now on, as ranks do that do not lead: another process speaks for all."""
    sys.stdout = sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - Until the process ends.


def drop_output() -> None:
    """Sends what is still to be printed nowhere, since nobody reads it any more."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)


class LogLines(logging.Handler):
    """Shows what is logged among the other lines of a command, above its progress bar; the same line once."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console
        self._shown: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Prints one record, unless its line is there already: planes are fitted twice in a training."""
        text = record.getMessage()
        if text in self._shown:
            return
        self._shown.add(text)
        if record.levelno >= logging.WARNING:
            warn(self._console, text)
        else:
            say(self._console, text)


@contextmanager
def heard_by(console: Console) -> Iterator[None]:
    """Shows on a console what the package logs and what libraries warn of, each as a line."""

    def show(message: Warning | str, *place: Any, **more: Any) -> None:
        warn(console, message)

    lines, root = LogLines(console), logging.getLogger()
    if not root.handlers:
        root.addHandler(lines)
    logging.getLogger("glassplat").setLevel(logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = show
            yield
    finally:
        root.removeHandler(lines)


WORDS = {
    name: word
    for name, word in (("SIGINT", "interrupted"), ("SIGTERM", "terminated"), ("SIGHUP", "the terminal was closed"))
    if hasattr(signal, name)  # Windows has no SIGHUP.
}
CODE_OF_SIGNALS = 128
"""Shells report a process that a signal ended by this plus the signal's number."""


class Interrupted(KeyboardInterrupt):
    """The command was asked to end.

    Attributes:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(WORDS[signal.Signals(number).name])
        self.number = number


def code_of(stop: KeyboardInterrupt) -> int:
    """The exit code: 130 after Ctrl-C, 143 and 129 after the two other signals."""
    return CODE_OF_SIGNALS + (stop.number if isinstance(stop, Interrupted) else signal.SIGINT)


@contextmanager
def raised_signals(*, is_program: bool = False) -> Iterator[list[Interrupted]]:
    """Turns the signals into `Interrupted`, raised where the command is, so that half-written files are removed.

    Gives the list of those raised: a library that is interrupted may end with an error of its own. Where the process
    ends after the command, a later signal ends it at once, not with a traceback of what it was tidying up.
    """
    raised: list[Interrupted] = []

    def stop(number: int, frame: FrameType | None) -> None:
        raised.append(Interrupted(number))
        raise raised[-1]

    with _install_handlers(stop, afterwards=signal.SIG_DFL if is_program else None):
        yield raised


@contextmanager
def immediate_end() -> Iterator[None]:
    """Ends the process at the first signal, with one line: for the seconds in which libraries are imported.

    Nothing has been written yet that would be left behind. An exception would not do: a library may take it for its
    own failure, or go on without the module that it was importing.
    """

    def end(number: int, frame: FrameType | None) -> None:
        stop = Interrupted(number)
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, f"{stop}\n".encode())
        os._exit(code_of(stop))

    with _install_handlers(end):
        yield


@contextmanager
def held_signals() -> Iterator[None]:
    """Answers signals when the context ends: for imports while something runs that has to be told to end."""
    held: list[int] = []
    with _install_handlers(lambda number, frame: held.append(number)):
        yield
    for number in held[:1]:
        signal.raise_signal(number)


@contextmanager
def _install_handlers(answer: signal._HANDLER, afterwards: signal._HANDLER | None = None) -> Iterator[None]:
    """Has the signals answered, but for those that the process was told to ignore, as by `nohup`.

    Args:
        answer: to a signal in this context.
        afterwards: from then on; None for what it was before.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # Only the main thread may say how signals are answered.
        return
    numbers = [getattr(signal, name) for name in WORDS]
    before = {number: signal.getsignal(number) for number in numbers}
    heard = [number for number, handler in before.items() if handler not in (signal.SIG_IGN, None)]
    for number in heard:
        signal.signal(number, answer)
    try:
        yield
    finally:
        for number in heard:
            signal.signal(number, before[number] if afterwards is None else afterwards)


BAD_INPUT_CODE, FAILURE_CODE = 2, 1
BAD_INPUT = ("glassplat.panes.PlaneFitError", "glassplat.kernels.backend.devices.CudaUnavailableError")
FAILURES = ("glassplat.training.loop.TrainingDivergedError",)
GPU_IS_FULL = ("torch.OutOfMemoryError",)
"""By name: this module is loaded before PyTorch, and also where PyTorch is what cannot be loaded."""
BAD_PATH = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
BAD_PATH_NUMBERS = (errno.ENAMETOOLONG, errno.ELOOP, errno.EROFS, errno.EINVAL)
FULL = (errno.ENOSPC, errno.EDQUOT)
OUT_OF_MEMORY = (
    "can't allocate memory",
    "Cannot allocate memory",
    "not enough memory",
    "bad_alloc",
    "bad allocation",
    "failed to map segment",
)
LONGEST_QUOTE = 300
REMEDY = "photographs made smaller (train with a larger --downscale) or fewer Gaussians need less"


class Ending(NamedTuple):
    """Text and exit code of a command's end: `error` for wrong input, `stopped` for a failure."""

    label: Literal["error", "stopped"]
    text: str
    code: int


def ending(error: BaseException) -> Ending:
    """The message and the exit code that an error ends a command with; one that nobody foresaw is saved to a file."""
    if isinstance(error, RankLostError):
        said = error.ending or ("stopped", str(error), FAILURE_CODE)
        return Ending("error" if said[0] == "error" else "stopped", *said[1:])
    if isinstance(error, InputError) or is_one_of(error, BAD_INPUT):
        return Ending("error", str(error), BAD_INPUT_CODE)
    if isinstance(error, OSError):
        bad_path = isinstance(error, BAD_PATH) or error.errno in BAD_PATH_NUMBERS
        label: Literal["error", "stopped"] = "error" if bad_path else "stopped"
        return Ending(label, described_os_error(error), BAD_INPUT_CODE if bad_path else FAILURE_CODE)
    return Ending("stopped", _failure(error), FAILURE_CODE)


def is_one_of(error: BaseException, names: tuple[str, ...]) -> bool:
    """Return whether an error is of a class given by name; one whose module is not loaded cannot have been raised."""
    for module, _, name in (full.rpartition(".") for full in names):
        kind = getattr(sys.modules.get(module), name, None)
        if kind is not None and isinstance(error, kind):
            return True
    return False


def described_os_error(error: OSError) -> str:
    """An error of the operating system in words: what it is about, what is wrong, and what helps."""
    if error.errno is None or error.strerror is None:
        return str(error)  # Our own, whose message says everything.
    subjects = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    about = f"{' -> '.join(subjects)}: " if subjects else ""
    remedy = "; free some space, then repeat the command" if error.errno in FULL else ""
    return f"{about}{error.strerror[:1].lower()}{error.strerror[1:]}{remedy}"


def _failure(error: BaseException) -> str:
    if is_one_of(error, FAILURES):
        return str(error)
    if is_one_of(error, GPU_IS_FULL):
        return f"{first_sentence(error)}; {REMEDY}, or use --device cpu; the last checkpoint stays"
    if is_out_of_memory(error):
        return f"out of memory ({first_sentence(error) or 'an allocation failed'}); {REMEDY}; the last checkpoint stays"
    said = first_sentence(error)
    return f"an error that glassplat did not foresee, {type(error).__name__}: {said}; {saved_traceback(error)}"


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether the CPU's memory ran out, or that is what made a library fail; many say so in words only."""
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, RuntimeError | ImportError | OSError) and any(text in str(error) for text in OUT_OF_MEMORY):
        return True
    return error.__cause__ is not None and is_out_of_memory(error.__cause__)


def first_sentence(error: BaseException) -> str:
    """The first sentence of somebody else's message, which may have many lines."""
    first = (str(error).strip().splitlines() or [""])[0].split(". ")[0].rstrip(".")
    return first if len(first) <= LONGEST_QUOTE else f"{first[:LONGEST_QUOTE]} ..."


def saved_traceback(error: BaseException) -> str:
    """Writes the traceback to a file among the temporary ones; says where, or where the error was if it cannot."""
    trace = "".join(traceback.format_exception(error))
    head = f"{versions()}\n{time.strftime('%Y-%m-%d %H:%M:%S %z')}\n{sys.argv}\n\n"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="glassplat-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write(head + trace)
    except OSError:
        frames = traceback.extract_tb(error.__traceback__)
        return f"raised in {frames[-1].filename}, line {frames[-1].lineno}" if frames else "its place is not known"
    return f"the traceback is in {file.name}. Please report it, with what you did"


def versions() -> str:
    """The versions of what runs here, the system and its GPU, in a line, without importing any of it."""
    return (
        f"glassplat {__version__}, Python {platform.python_version()}, PyTorch {_version('torch')}, "
        f"Numba {_version('numba')}, {platform.system()} {platform.release()} {platform.machine()}, "
        f"{os.cpu_count()} CPU cores, {_gpu()}"
    )


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def _gpu() -> str:
    """The NVIDIA GPU that the driver names first."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return "no NVIDIA driver"
    name, version = ctypes.create_string_buffer(256), ctypes.c_int()
    if driver.cuInit(0) or driver.cuDeviceGetName(name, 256, 0) or driver.cuDriverGetVersion(ctypes.byref(version)):
        return "an NVIDIA driver without a GPU"
    return f"{name.value.decode(errors='replace')} (CUDA {version.value // 1000}.{version.value % 1000 // 10})"


def check_arguments(arguments: Sequence[str]) -> None:
    """Refuses empty arguments after a command: as a path, an empty text is the folder that it was started in."""
    for before, argument in itertools.pairwise(arguments):
        option, is_joined, value = argument.partition("=")
        if argument == "" or (option.startswith("--") and is_joined and not value):
            name = option or before
            raise InputError(f"what follows {name} is empty, as of a shell variable that is not set; expected a value")


def similar(word: str, known: Iterable[str]) -> list[str]:
    """The known word that a mistyped one resembles most; none where it resembles none."""
    return difflib.get_close_matches(word, list(known), n=1, cutoff=0.7)


def no_such(what: str, word: str, known: Iterable[str], command: str) -> str:
    """The message about a word that is no command or method: the one meant perhaps, all of them, and their help."""
    meant = similar(word, known)
    guess = f"did you mean {meant[0]}? There are" if meant else "expected one of"
    return f"there is no {what} {word!r}; {guess} {', '.join(known)}: see {command}"


BOX = re.compile(r"\x1b\[[0-9;]*m|[│─╭╮╰╯]|-{5,}")
"""What frames and colours tyro's messages."""
NUMBERS = {"INT": "whole number", "FLOAT": "number"}
"""Of tyro's signs for what an option takes, those that it explains in Python's words."""
NOT_A_NUMBER = re.compile(
    r"Error parsing (--[\w./-]+):.*Argument helptext:[ \n]+--[\w., -]+? ((?:INT|FLOAT|None|[|{} ])+)"
)


def refused_options(said: str) -> str:
    """tyro's message about a command line as one line, without its box, its title and its pointer to the help."""
    title, _, text = BOX.sub("", said).strip().partition("\n")
    text = " ".join(text.partition("For full helptext")[0].split()).removeprefix("Error parsing ")
    text = re.sub(r"\.? \(required\)", ";", text).rstrip(".;")
    return f"{text[:1].lower()}{text[1:]}" or title.strip()


def wrong_number(said: str, arguments: Sequence[str]) -> str | None:
    """In place of tyro's message about an option that takes numbers, what it takes and what came; None for others."""
    if (found := NOT_A_NUMBER.search(" ".join(BOX.sub("", said).split()))) is None:
        return None
    names = found[1].split("/")
    place = max((at for at, word in enumerate(arguments) if word.partition("=")[0] in names), default=-1)
    option, _, value = arguments[place].partition("=") if place >= 0 else (names[0], "", "")
    came = (
        [value] if value else list(itertools.takewhile(lambda word: not word.startswith("--"), arguments[place + 1 :]))
    )
    expected = " or ".join(numbers_in_words(signs.strip("{} ")) for signs in found[2].split("|"))
    return f"{option}: expected {expected}, not {' '.join(came)!r}"


def numbers_in_words(signs: str) -> str:
    """An option's values in words, as in "3 numbers" for "FLOAT FLOAT FLOAT"."""
    kinds = signs.split()
    word = NUMBERS.get(kinds[0])
    return signs if word is None else f"a {word}" if len(kinds) == 1 else count_noun(len(kinds), word)


LINE = "loading PyTorch ..."
"""Shown in a terminal only, and gone when the work begins. The cursor stays: Ctrl-C may end the process at once."""


def import_now(module: str) -> Any:
    """A module of `glassplat` that imports PyTorch, by its dotted name, imported now if it is not there yet."""
    with _without_garbage_collection(), _announce(message_console(stderr=True), module):
        return importlib.import_module(module)


def import_held(module: str) -> Any:
    """The same while a command works: signals are answered after the import, which must not break off."""
    with held_signals():
        return import_now(module)


class Command:
    """Base of the commands whose work is a function `(command, console)` of a module that imports PyTorch.

    Attributes:
        work: the module in `glassplat.cli`, and the function.
        left: what an interrupt leaves behind, and how to go on; fields of the command stand in braces.
    """

    work: ClassVar[str]
    left: ClassVar[str]

    def check(self) -> None:
        """Refuses what can be refused before that takes long."""
        raise NotImplementedError

    def ready(self) -> None:
        """Refuses what can be refused, and imports what works."""
        self.check()
        import_now(f"glassplat.cli.{self.work.partition(':')[0]}")

    def run(self, console: Console) -> None:
        """Does the work."""
        module, _, function = self.work.partition(":")
        getattr(importlib.import_module(f"glassplat.cli.{module}"), function)(self, console)

    def left_behind(self) -> str:
        """Text after an interrupt: the state on disk, and how to go on."""
        return self.left.format(**vars(self))


@contextmanager
def _announce(console: Console, module: str) -> Iterator[None]:
    """Shows the line meanwhile, where somebody may be watching and the module is not there yet."""
    if module in sys.modules or not console.is_interactive:
        yield
        return
    console.print(LINE, end="", highlight=False)
    try:
        yield
    finally:
        console.control(Control(ControlType.CARRIAGE_RETURN, (ControlType.ERASE_IN_LINE, 2)))


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
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
