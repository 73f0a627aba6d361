"""How a command ends when it does not end well: one readable message and an exit code for every error there is."""

from __future__ import annotations

import errno
import importlib.metadata
import os
import platform
import sys
import tempfile
import time
import traceback
from typing import Literal, NamedTuple

from glassplat import __version__
from glassplat.data.errors import InputError

BAD_INPUT_CODE, FAILURE_CODE = 2, 1
BAD_INPUT = ("glassplat.init.plane_options.PlaneFitError", "glassplat.kernels.backend.devices.CudaUnavailableError")
FAILURES = ("glassplat.train.trainer.TrainingDivergedError",)
GPU_IS_FULL = ("torch.OutOfMemoryError",)
"""By name: this module is loaded before PyTorch, and also where PyTorch is what cannot be loaded."""
BAD_PATH = (
    FileNotFoundError,
    FileExistsError,
    NotADirectoryError,
    IsADirectoryError,
    PermissionError,
)
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
    """What is said and returned at the end of a command: `error` for wrong input, `stopped` for a failure."""

    label: Literal["error", "stopped"]
    text: str
    code: int


def ending(error: BaseException) -> Ending:
    """The message and the exit code that an error ends a command with; one that nobody foresaw is saved to a file."""
    if isinstance(error, InputError) or is_one_of(error, BAD_INPUT):
        return Ending("error", str(error), BAD_INPUT_CODE)
    if isinstance(error, OSError):
        bad_path = isinstance(error, BAD_PATH) or error.errno in BAD_PATH_NUMBERS
        label: Literal["error", "stopped"] = "error" if bad_path else "stopped"
        return Ending(label, described_os_error(error), BAD_INPUT_CODE if bad_path else FAILURE_CODE)
    return Ending("stopped", _failure(error), FAILURE_CODE)


def is_one_of(error: BaseException, names: tuple[str, ...]) -> bool:
    """Whether an error is of a class given by name; one whose module is not loaded cannot have been raised."""
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
        return f"{quoted(error)}; {REMEDY}, or use --device cpu; the last checkpoint stays"
    if is_out_of_memory(error):
        return f"out of memory ({quoted(error) or 'an allocation failed'}); {REMEDY}; the last checkpoint stays"
    return f"an error that glassplat did not foresee, {type(error).__name__}: {quoted(error)}; {saved_traceback(error)}"


def is_out_of_memory(error: BaseException) -> bool:
    """Whether the CPU's memory ran out, or that is what made a library fail; many say so in words only."""
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, RuntimeError | ImportError | OSError) and any(text in str(error) for text in OUT_OF_MEMORY):
        return True
    return error.__cause__ is not None and is_out_of_memory(error.__cause__)


def quoted(error: BaseException) -> str:
    """The first sentence of somebody else's message, which may have many lines."""
    first = (str(error).strip().splitlines() or [""])[0].split(". ")[0].rstrip(".")
    return first if len(first) <= LONGEST_QUOTE else f"{first[:LONGEST_QUOTE]} ..."


def saved_traceback(error: BaseException) -> str:
    """Writes the traceback to a file among the temporary ones; says where, or where the error was if it cannot."""
    trace = "".join(traceback.format_exception(error))
    head = (
        f"glassplat {__version__}, Python {platform.python_version()}, PyTorch {_version('torch')}, "
        f"Numba {_version('numba')}, {platform.system()} {platform.release()} {platform.machine()}\n"
        f"{time.strftime('%Y-%m-%d %H:%M:%S %z')}\n{sys.argv}\n\n"
    )
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="glassplat-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write(head + trace)
    except OSError:
        frames = traceback.extract_tb(error.__traceback__)
        return f"raised in {frames[-1].filename}, line {frames[-1].lineno}" if frames else "its place is not known"
    return f"the traceback is in {file.name}. Please report it, with what you did"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
