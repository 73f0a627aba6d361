"""Folders of compiled kernels: fallbacks for unwritable folders, and use of kernels that are already stored."""

from __future__ import annotations

import importlib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

from glassplat.kernels.backend import cpu_cache as cache_folders

KERNEL = """
from glassplat.kernels.backend.cpu import kernel

def made(real):
    @kernel("scale", real, parallel=False)
    def scale(values):
        for i in range(values.size):
            values[i] = 4 * values[i]

    return scale
"""


@dataclass
class Machine:
    """A package, a home and a folder for temporary files, some of which cannot be written."""

    root: Path
    log: pytest.LogCaptureFixture
    closed: list[Path] = field(default_factory=list)

    def __post_init__(self) -> None:
        for folder in (self.package, self.home, self.temporary):
            folder.mkdir()
        (self.package / "scale_in_package.py").write_text(KERNEL)

    @property
    def package(self) -> Path:
        return self.root / "package"

    @property
    def home(self) -> Path:
        return self.root / "home"

    @property
    def temporary(self) -> Path:
        return self.root / "temporary"

    def refuse(self, path: object) -> None:
        """Denies access as for a user without permission; the tests may run as root, who may write everywhere."""
        if any(Path(str(path)).absolute().is_relative_to(folder) for folder in self.closed):
            raise PermissionError(13, "Permission denied", str(path))

    def run(self) -> tuple[int, list[str]]:
        """Runs the kernel as a new process would; returns the number of compilations and the other messages."""
        cache_folders._warn_once.cache_clear()
        self.log.clear()
        sys.modules.pop("scale_in_package", None)
        scale = importlib.import_module("scale_in_package").made(np.float32)
        values = np.ones(2, np.float32)
        scale(values)
        assert values.tolist() == [4, 4]
        said = [line for line in self.log.messages if "scale_float32 " not in line]
        return scale.compilations, said


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Machine:
    """A machine on which the package's folder is not writable."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    caplog.set_level(logging.INFO, logger="glassplat.kernels")
    made = Machine(tmp_path, caplog)
    made.closed.append(made.package)
    monkeypatch.syspath_prepend(made.package)
    refused(machine=made, monkeypatch=monkeypatch)
    return made


def refused(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes the machine deny writes to closed folders."""
    whole: dict[str, Callable[..., Any]] = {
        "temporary": tempfile.TemporaryFile,
        "mkdir": os.mkdir,
        "open": IndexDataCacheFile._open_for_write,
    }

    def temporary(*, dir: str) -> Any:
        machine.refuse(dir)
        return whole["temporary"](dir=dir)

    def make(path: Any, *arguments: Any, **options: Any) -> None:
        machine.refuse(path)
        whole["mkdir"](path, *arguments, **options)

    def opened(self: Any, path: str) -> Any:
        machine.refuse(path)
        return whole["open"](self, path)

    monkeypatch.setattr(tempfile, "TemporaryFile", temporary)
    monkeypatch.setattr(os, "mkdir", make)
    monkeypatch.setattr(IndexDataCacheFile, "_open_for_write", opened)


def test_a_read_only_package_keeps_kernels_in_the_users_cache_folder(machine: Machine) -> None:
    assert machine.run() == (1, [])
    assert list(machine.home.rglob("*.nbc"))
    assert machine.run() == (0, [])


def test_without_a_home_they_are_kept_among_the_temporary_files_with_one_warning(machine: Machine) -> None:
    machine.closed.append(machine.home)
    compilations, (said,) = machine.run()
    assert compilations == 1
    assert said.startswith(f"compiled kernels are kept in {machine.temporary}")
    assert "set NUMBA_CACHE_DIR to a folder" in said
    assert machine.run() == (0, [])
    (folder,) = machine.temporary.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("home", ["/dev/null", "~", "relative"])
def test_a_missing_home_creates_no_folder_in_the_working_directory(
    machine: Machine, home: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = machine.root / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setenv("HOME", home)
    compilations, (said,) = machine.run()
    assert compilations == 1
    assert str(machine.temporary) in said
    assert not list(here.iterdir())


@pytest.mark.parametrize("kind", ["writable", "link"])
def test_a_temporary_folder_that_others_can_write_is_not_trusted(machine: Machine, kind: str) -> None:
    machine.closed.append(machine.home)
    machine.run()
    (folder,) = machine.temporary.iterdir()
    folder.chmod(0o777)
    if kind == "link":
        folder.rename(machine.root / "elsewhere")
        folder.symlink_to(machine.root / "elsewhere")
    compilations, (said,) = machine.run()
    assert compilations == 1
    assert "cannot cache compiled kernels" in said


def test_a_kernel_is_compiled_with_a_message_if_the_cache_is_unwritable(machine: Machine) -> None:
    machine.closed.append(machine.root)
    compilations, (said,) = machine.run()
    assert compilations == 1
    assert said.startswith("cannot cache compiled kernels: ")
    assert "set NUMBA_CACHE_DIR" in said


@pytest.mark.parametrize("warmed", ["package", "home", "chosen"])
def test_stored_kernels_are_used_if_nothing_can_be_written(
    machine: Machine, warmed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if warmed == "chosen":
        monkeypatch.setattr(numba.config, "CACHE_DIR", str(machine.root / "chosen"))
    if warmed == "package":
        machine.closed.clear()
    assert machine.run() == (1, [])
    machine.closed.append(machine.root)
    assert machine.run() == (0, [])


def test_a_chosen_folder_that_cannot_be_written_is_named(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", "/dev/null/cache")
    compilations, (said,) = machine.run()
    assert compilations == 1
    assert said.startswith("NUMBA_CACHE_DIR is /dev/null/cache, which cannot be written; compiled kernels are kept in")


def test_a_chosen_cache_folder_does_not_hide_kernels_next_to_the_sources(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.closed.clear()
    assert machine.run() == (1, [])
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(machine.root / "empty"))
    assert machine.run() == (0, [])


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", ["empty", "cut", "text", "folder"])
def test_a_damaged_file_is_compiled_again_and_replaced(machine: Machine, suffix: str, damage: str) -> None:
    machine.run()
    (file,) = machine.home.rglob(f"*.{suffix}")
    content = file.read_bytes()
    file.unlink()
    if damage == "folder":
        file.mkdir()
    else:
        file.write_bytes({"empty": b"", "cut": content[: len(content) // 2], "text": b"not a kernel\n"}[damage])
    compilations, said = machine.run()
    assert compilations == 1
    assert said and all("cannot be read" in line or "cannot cache" in line for line in said)
    if damage == "folder":
        shutil.rmtree(file)
        machine.run()
    assert machine.run() == (0, [])
