"""Where compiled kernels are kept: the first folder that can be written, out of four.

They are NUMBA_CACHE_DIR where it is set, `__pycache__` beside the kernel's source, the user's cache folder, and one in
the folder for temporary files. What lies ready in one of them is used also where nothing can be written, as in a
container whose kernels were compiled when it was built.
"""

from __future__ import annotations

import logging
import os
import stat
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import (
    CompileResultCacheImpl,
    IndexDataCacheFile,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)

log = logging.getLogger("glassplat.kernels")

REMEDY = "set NUMBA_CACHE_DIR to a folder that can be written and lasts"


class UserFolder(UserWideCacheLocator):
    """The user's cache folder, if there is one."""

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """The folder for a kernel; None where it cannot be written, or where a user without a home has none."""
        # Without a home, `~` stays as it is, and a folder of that name would appear wherever the command runs.
        return (
            super().from_function(py_func, py_file) if os.path.isabs(cls(py_func, py_file).get_cache_path()) else None
        )


class TemporaryFolder(InTreeCacheLocator):
    """A folder among the temporary files that nobody else can write to, since what is in it will be executed."""

    def get_cache_path(self) -> str:
        """The folder for the kernel's module."""
        return os.path.join(_temporary_root(), self.get_suitable_cache_subpath(self._py_file))

    def ensure_cache_path(self) -> None:
        """Makes the folder.

        Raises:
            OSError: it cannot be written, or belongs to somebody else.
        """
        root = Path(_temporary_root())
        root.mkdir(mode=0o700, exist_ok=True)
        found = root.lstat()
        if not stat.S_ISDIR(found.st_mode) or _user() not in (None, found.st_uid) or found.st_mode & 0o022:
            raise PermissionError(f"{root} can be written by others")
        super().ensure_cache_path()


class Nowhere(InTreeCacheLocator):
    """The folder beside the source when none can be written: kernels are read from it, and saving fails."""

    def ensure_cache_path(self) -> None:
        """Leaves everything as it is; whether something can be saved shows when it is."""


class KernelFiles(CompileResultCacheImpl):
    """How compiled kernels become files, and where: in the first folder that can be written."""

    _locator_classes = (UserProvidedCacheLocator, InTreeCacheLocator, UserFolder, TemporaryFolder, Nowhere)

    def files(self, function: Callable[..., Any]) -> list[IndexDataCacheFile]:
        """The kernel's file in every folder, first the one that is written to."""
        folders = [self.locator.get_cache_path()]
        if not numba.config.CACHE_LOCATOR_CLASSES:  # Numba's own way to ask for one folder and no other.
            kinds = [InTreeCacheLocator, UserFolder]
            if numba.config.CACHE_DIR:
                kinds.insert(0, UserProvidedCacheLocator)
            folders += [kind(function, self.locator._py_file).get_cache_path() for kind in kinds]
        stamp = self.locator.get_source_stamp()
        return [IndexDataCacheFile(folder, self.filename_base, stamp) for folder in dict.fromkeys(folders)]

    def remark(self) -> None:
        """Says, once, when kernels are not kept where the user may expect them."""
        folder = os.path.dirname(self.locator.get_cache_path())
        if isinstance(self.locator, TemporaryFolder):
            _warn_once(
                "compiled kernels are kept in %s, which may not last: neither the package nor the user's cache "
                "folder can be written; %s",
                folder,
                REMEDY,
            )
        elif numba.config.CACHE_DIR and not isinstance(self.locator, UserProvidedCacheLocator):
            _warn_once(
                "NUMBA_CACHE_DIR is %s, which cannot be written; compiled kernels are kept in %s",
                numba.config.CACHE_DIR,
                self.locator.get_cache_path(),
            )

    def not_kept(self, reason: Exception) -> None:
        """Says, once, that kernels will be compiled again in the next process."""
        _warn_once("cannot keep compiled kernels for the next time: %s; %s", str(reason), REMEDY)


@cache
def _warn_once(text: str, *values: str) -> None:
    log.warning(text, *values)


def _temporary_root() -> str:
    return os.path.join(tempfile.gettempdir(), f"glassplat-kernels-{_user()}")


def _user() -> int | None:
    """The user's number; None where users have none."""
    return os.getuid() if hasattr(os, "getuid") else None
