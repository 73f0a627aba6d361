"""Machine code of CUDA kernels: how it is compiled, and the cache on the disk.

No driver takes part: NVVM makes PTX, and nvJitLink a cubin of it. The cache has one file for each kernel and compute
capability, beside those of the CPU. A file holds what it was made from as a digest, a digest of its own content, the
kernel's name in the cubin, and the cubin. What does not fit, another version's file or a damaged one, is compiled again
and replaced.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import tempfile
import time
from collections.abc import Callable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from cuda import pathfinder
from cuda.core import Linker, LinkerOptions, ObjectCode
from numba import cuda
from numba.core.caching import FunctionCache

from glassplat.kernels.backend.cpu_cache import fingerprint

ENTRY = re.compile(r"\.entry\s+([\w$]+)\s*\(")
COMPILERS = (
    "numba",
    "numba-cuda",
    "llvmlite",
    "cuda-core",
    "nvidia-nvvm",
    "nvidia-nvjitlink",
    "nvidia-cuda-nvcc-cu12",
    "nvidia-nvjitlink-cu12",
)
"""Distributions that decide what the compiler makes."""


class MachineCode(NamedTuple):
    """A kernel for one compute capability: its name in the cubin, and the cubin."""

    entry: str
    cubin: bytes


def compiled(
    function: Callable[..., None],
    signature: tuple[Any, ...],
    capability: tuple[int, int],
    bounds: tuple[int, int] | None,
) -> MachineCode:
    """Compiles a kernel.

    Args:
        function: the kernel in Python.
        signature: the Numba types of its arguments.
        capability: compute capability (major, minor) of the GPU.
        bounds: threads of a block, and how many blocks a multiprocessor should hold at once.
    """
    text, _ = cuda.compile(
        function, signature, device=False, abi="numba", cc=capability, launch_bounds=bounds, debug=False, opt=True
    )
    (entry,) = ENTRY.findall(text)
    options = LinkerOptions(arch=f"sm_{capability[0]}{capability[1]}")
    linked = Linker(ObjectCode.from_ptx(text.encode()), options=options).link("cubin")
    return MachineCode(entry, bytes(linked.code))


@cache
def compiler_versions() -> str:
    """Versions of the compilers that a compiled kernel depends on."""
    return " ".join([*(f"{name} {_version(name)}" for name in COMPILERS), f"linker {_linker_version()}"])


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


def _linker_version() -> Any:
    from cuda.bindings import driver, nvjitlink

    try:
        return nvjitlink.version()
    except (RuntimeError, pathfinder.DynamicLibNotFoundError):
        # Without nvJitLink the driver links, and its version is what counts.
        return driver.cuDriverGetVersion()[1]


log = logging.getLogger("glassplat.kernels")

MAGIC = b"glassplat cubin 1\n"
DIGEST = hashlib.sha256().digest_size


class ImageCache:
    """The machine code of one kernel: from the disk, or from the compiler, which is announced.

    Attributes:
        name: of the kernel and its files.
    """

    def __init__(
        self, function: Callable[..., None], name: str, signature: tuple[Any, ...], bounds: tuple[int, int] | None
    ) -> None:
        self.name = name
        self._function = function
        self._signature = signature
        self._bounds = bounds

    def machine_code(self, capability: tuple[int, int]) -> MachineCode:
        """The kernel for a compute capability (major, minor), compiled unless the disk has it."""
        path, key = self.path(capability), self.key(capability)
        found = None if path is None else _read(path, key)
        if found is not None:
            return found
        log.info("compiling %s for this GPU (first use only, then cached on disk) ...", self.name)
        started = time.perf_counter()
        made = compiled(self._function, self._signature, capability, self._bounds)
        log.info("compiled %s in %.1f s", self.name, time.perf_counter() - started)
        if path is not None:
            self._keep(path, key, made)
        return made

    def path(self, capability: tuple[int, int]) -> Path | None:
        """The kernel's file, in the folder that Numba chooses for CPU kernels too; None where none can be written."""
        try:
            folder = FunctionCache(self._function).cache_path
        except RuntimeError as error:
            log.warning("cannot keep %s for the next time: %s", self.name, error)
            return None
        return Path(folder) / f"{self.name}.sm_{capability[0]}{capability[1]}.cubin"

    def key(self, capability: tuple[int, int]) -> bytes:
        """Digest of the kernel's code and that of all functions it uses, its types, and whatever compiles it."""
        flags = f"{self._signature} {self._bounds} {capability} {compiler_versions()}"
        return bytes.fromhex(fingerprint(self._function, flags))

    def _keep(self, path: Path, key: bytes, made: MachineCode) -> None:
        try:
            _write(path, key, made)
        except OSError as error:
            log.warning("cannot keep %s for the next time: %s", self.name, error)


def _write(path: Path, key: bytes, made: MachineCode) -> None:
    """Puts a whole file in place at once: who reads at the same time finds the old one or the new one."""
    content = made.entry.encode() + b"\0" + made.cubin
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=path.name, delete=False) as file:
        try:
            file.write(MAGIC + key + hashlib.sha256(content).digest() + content)
            file.close()
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise


def _read(path: Path, key: bytes) -> MachineCode | None:
    """The machine code of a file made under this key; None where it is missing, foreign or damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    at = len(MAGIC) + DIGEST
    head, digest, content = data[:at], data[at : at + DIGEST], data[at + DIGEST :]
    if head != MAGIC + key or hashlib.sha256(content).digest() != digest:
        return None
    entry, _, cubin = content.partition(b"\0")
    return MachineCode(entry.decode(), cubin)
