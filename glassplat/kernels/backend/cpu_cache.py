"""On-disk cache of compiled kernels: keys that are stable across processes, and the folders that are used.

Kernels are stored in the first writable one of four folders: NUMBA_CACHE_DIR if set, `__pycache__` next to the kernel's
source, the user's cache folder, and one among the temporary files. Stored kernels are used even if no folder is
writable, as in a container whose kernels were compiled when it was built.
"""

from __future__ import annotations

import dis
import hashlib
import logging
import os
import pickle
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import caching, types
from numba.core.cpu import CPUContext
from numba.core.registry import cpu_target

from glassplat.kernels.backend.devices import announce_compilation

log = logging.getLogger("glassplat.kernels")

REMEDY = "set NUMBA_CACHE_DIR to a folder that is writable and permanent"


class UserFolder(caching.UserWideCacheLocator):
    """The user's cache folder, if there is one."""

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """The folder for a kernel; None if it is not writable, or the user has no home directory."""
        # Without a home directory `~` is not expanded, and a folder of that name would appear in the current one.
        return (
            super().from_function(py_func, py_file) if os.path.isabs(cls(py_func, py_file).get_cache_path()) else None
        )


class TemporaryFolder(caching.InTreeCacheLocator):
    """A temporary folder that no other user can write to, because its contents are executed."""

    def get_cache_path(self) -> str:
        """The folder for the kernel's module."""
        return os.path.join(_temporary_root(), self.get_suitable_cache_subpath(self._py_file))

    def ensure_cache_path(self) -> None:
        """Creates the folder.

        Raises:
            OSError: it is not writable, or belongs to another user.
        """
        root = Path(_temporary_root())
        root.mkdir(mode=0o700, exist_ok=True)
        found = root.lstat()
        if not stat.S_ISDIR(found.st_mode) or _user() not in (None, found.st_uid) or found.st_mode & 0o022:
            raise PermissionError(f"{root} can be written by others")
        super().ensure_cache_path()


class ReadOnlyFolder(caching.InTreeCacheLocator):
    """The folder next to the source, if none is writable: kernels are read from it, and saving fails."""

    def ensure_cache_path(self) -> None:
        """Does nothing; saving fails later if the folder is not writable."""


class KernelFiles(caching.CompileResultCacheImpl):
    """Files of compiled kernels, in the first writable folder."""

    _locator_classes = (
        caching.UserProvidedCacheLocator,
        caching.InTreeCacheLocator,
        UserFolder,
        TemporaryFolder,
        ReadOnlyFolder,
    )

    def files(self, function: Callable[..., Any]) -> list[caching.IndexDataCacheFile]:
        """The kernel's file in every folder; the first one is written to."""
        folders = [self.locator.get_cache_path()]
        if not numba.config.CACHE_LOCATOR_CLASSES:  # Numba's own setting for a single folder.
            kinds = [caching.InTreeCacheLocator, UserFolder]
            if numba.config.CACHE_DIR:
                kinds.insert(0, caching.UserProvidedCacheLocator)
            folders += [kind(function, self.locator._py_file).get_cache_path() for kind in kinds]
        stamp = self.locator.get_source_stamp()
        return [caching.IndexDataCacheFile(folder, self.filename_base, stamp) for folder in dict.fromkeys(folders)]

    def warn_if_elsewhere(self) -> None:
        """Logs once if kernels are not stored where the user may expect them."""
        folder = os.path.dirname(self.locator.get_cache_path())
        if isinstance(self.locator, TemporaryFolder):
            _warn_once(
                "compiled kernels are kept in %s, which may not last: neither the package nor the user's cache "
                "folder can be written; %s",
                folder,
                REMEDY,
            )
        elif numba.config.CACHE_DIR and not isinstance(self.locator, caching.UserProvidedCacheLocator):
            _warn_once(
                "NUMBA_CACHE_DIR is %s, which cannot be written; compiled kernels are kept in %s",
                numba.config.CACHE_DIR,
                self.locator.get_cache_path(),
            )

    def store(self, file: caching.IndexDataCacheFile, key: Any, data: Any) -> None:
        """Stores data under a key, or logs once that kernels will be compiled again in the next process.

        A damaged index, which cannot be extended, is replaced by a new one.
        """
        try:
            self.locator.ensure_cache_path()
            try:
                file.save(key, data)
            except DAMAGE_ERRORS:
                file.flush()
                file.save(key, data)
        except OSError as error:
            _warn_once("cannot cache compiled kernels: %s; %s", str(error), REMEDY)
        else:
            self.warn_if_elsewhere()


@cache
def _warn_once(text: str, *values: str) -> None:
    log.warning(text, *values)


def _temporary_root() -> str:
    return os.path.join(tempfile.gettempdir(), f"glassplat-kernels-{_user()}")


def _user() -> int | None:
    """The user's ID; None on systems without user IDs."""
    return os.getuid() if hasattr(os, "getuid") else None


LITERAL_TYPES = (bool, int, float, complex, str, bytes, type(None), np.generic)
NAMED_TYPES = (ModuleType, type, BuiltinFunctionType, np.ufunc)
TEXT_TYPES = (types.Type, ir.Type)
"""Types that are fully described by their text."""
LIBRARIES = ("numba", "numpy", "llvmlite")
PACKAGE = __name__.partition(".")[0]
DAMAGE_ERRORS = (EOFError, pickle.UnpicklingError, AttributeError, ImportError, LookupError, TypeError, ValueError)
"""Exceptions on reading a file that is truncated, or was written by another program."""


def fingerprint(function: Callable[..., Any], flags: str) -> str:
    """Digest of everything that a compiled function depends on.

    That is its bytecode and constants, its closure, the globals that it reads, also from other modules of the package,
    and the same for every function among those. Equal sources give equal digests in every process.

    Args:
        function: a Python function, before compilation.
        flags: the compiler options as text.

    Raises:
        TypeError: the function uses a value that has no stable description.
    """
    digest = hashlib.sha256(flags.encode())
    for part in _describe(function, {}):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()


def _describe(value: Any, seen: dict[int, int]) -> Iterator[str]:
    """The value as text, part by part; each function is described once, and referred to by its number afterwards."""
    if isinstance(value, LITERAL_TYPES):
        yield f"{type(value).__name__} {value!r}"
    elif isinstance(value, tuple | frozenset):
        parts = [" ".join(_describe(item, seen)) for item in value]
        yield f"{type(value).__name__} of {len(parts)}"
        yield from sorted(parts) if isinstance(value, frozenset) else parts
    elif isinstance(value, CodeType):
        yield value.co_code.hex()
        yield " ".join(value.co_names)
        yield from _describe(value.co_consts, seen)
    elif isinstance(value, NAMED_TYPES) or (isinstance(value, FunctionType) and value.__module__.startswith(LIBRARIES)):
        yield f"{getattr(value, '__module__', '')} {value.__name__}"
    elif isinstance(value, TEXT_TYPES):
        yield f"{type(value).__name__} {value}"
    elif isinstance(value, FunctionType):
        number = seen.get(id(value), len(seen))
        yield f"function {number}"
        if number == len(seen):
            seen[id(value)] = number
            yield from _described_function(value, seen)
    elif type(value).__name__ == "_Intrinsic":
        # An intrinsic of Numba or of numba-cuda, which is described by its definition.
        yield from _describe(value._defn, seen)
    else:
        raise TypeError(
            f"a kernel uses {value!r}, a {type(value).__name__}, whose changes the cache would not notice; expected "
            "numbers, strings, tuples, types, modules and functions that are plain or marked `inlined`"
        )


def _described_function(function: FunctionType, seen: dict[int, int]) -> Iterator[str]:
    """Bytecode, defaults, and values read from the closure and the globals of a function."""
    yield from _describe(function.__code__, seen)
    yield from _describe(function.__defaults__, seen)
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    known = function.__globals__ | {name: cell.cell_contents for name, cell in cells}
    for path in sorted(_read_paths(function.__code__)):
        if path[0] not in known:
            continue  # A built-in function, or a variable of this function that a nested one reads.
        value = known[path[0]]
        for name in path[1:]:
            if isinstance(value, ModuleType) and value.__name__.partition(".")[0] == PACKAGE:
                value = getattr(value, name)
        yield f"reads {'.'.join(path)}"
        yield from _describe(value, seen)


def _read_paths(code: CodeType) -> set[tuple[str, ...]]:
    """Names of other scopes that a code object and those nested in it read, each with the attributes that follow it."""
    found: set[tuple[str, ...]] = set()
    path: tuple[str, ...] = ()
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_GLOBAL", "LOAD_DEREF"):
            path = (step.argval,)
        elif step.opname != "EXTENDED_ARG":
            path = (*path, step.argval) if path and step.opname in ("LOAD_ATTR", "LOAD_METHOD") else ()
        found.add(path)
    nested = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return found.union(*map(_read_paths, nested)) - {()}


def load_data(files: Iterable[caching.IndexDataCacheFile], key: Any) -> Any:
    """Data stored under a key, from the first folder that has it; None if no folder has. Damaged files are skipped."""
    for file in files:
        try:
            data = file.load(key)
        except OSError:
            continue  # Not a folder, or not readable by this user.
        except DAMAGE_ERRORS as error:
            log.warning("%s cannot be read (%s); compiling again", file._index_path, error)
            continue
        if data is not None:
            return data
    return None


@cache
def loading_context() -> CPUContext:
    """Context for loading kernels that this process compiled, separate from the compiler's."""
    return CPUContext(cpu_target.typing_context, "cpu")


class KernelCache(caching.FunctionCache):
    """Numba's on-disk cache, with keys that are stable across processes, and an announcement of each compilation. The
    process that compiles a kernel runs the same machine code as all others.

    Numba's own key pickles a function's closure. Those bytes depend on which strings happen to be the same object in
    memory, so that a program with another import order would compile everything again.

    The compiler optimises the body of a `prange` twice: by itself, and again as a part of the kernel. The compiling
    process would run the first result, and processes that load the kernel the second; the two may round differently.
    Compiled kernels are therefore always loaded from the disk.
    """

    _impl_class = KernelFiles

    def __init__(self, function: Callable[..., Any], compiled: Callable[..., Any], flags: str) -> None:
        super().__init__(function)
        self._function, self._compiled = function, compiled
        self._name_shown = function.__name__
        self._files = self._impl.files(function)
        self._fingerprint = fingerprint(function, flags)
        self.compilations = 0

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel for a signature from the first folder that has it; damaged files are skipped."""
        data = load_data(self._files, self._index_key(sig, target_context.codegen()))
        return None if data is None else self._impl.rebuild(target_context, data)

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, Any, str]:
        return sig, codegen.magic_tuple(), self._fingerprint

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel for a signature; compiles it first, with an announcement, if it is not on disk."""
        found = super().load_overload(sig, target_context)
        if found is None:
            with announce_compilation(self._name_shown, "this machine"):
                dispatcher = self._compiled(self._function)
                dispatcher.compile(sig)
            (made,) = dispatcher.overloads.values()
            self.compilations += 1
            self._impl.store(self._cache_file, self._index_key(sig, made.codegen), self._impl.reduce(made))
            # If it could not be stored, the compiler's own result is used, without its timing metadata.
            found = super().load_overload(sig, loading_context()) or made._replace(metadata=None)
        return found
