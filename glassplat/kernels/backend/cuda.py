"""Declaration, compilation and launch of CUDA kernels: one place for the flags and for what torch and Numba share.

Memory, sorting and scans belong to torch; a kernel gets views of its tensors and runs on its current stream. Numba's
own launch looks at each array for microseconds; here the arguments are written out as its calling convention wants.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import math
import re
import struct
import threading
from collections.abc import Callable
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import numpy as np
import torch
from cuda import pathfinder
from cuda.bindings import driver
from cuda.core import Linker, LinkerOptions, ObjectCode
from numba import config, cuda, types
from torch import Tensor

from glassplat.kernels.backend.cpu_cache import KernelFiles, fingerprint, keep_data, kept_data
from glassplat.kernels.backend.devices import SIMULATED, announced_compilation

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


def compile_kernel(
    function: Callable[..., None], signature: tuple[Any, ...], capability: tuple[int, int]
) -> MachineCode:
    """Compiles a kernel.

    Args:
        function: the kernel in Python.
        signature: the Numba types of its arguments.
        capability: compute capability (major, minor) of the GPU.
    """
    text, _ = cuda.compile(function, signature, device=False, abi="numba", cc=capability, debug=False, opt=True)
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


class ImageCache:
    """The machine code of one kernel: from the disk, or from the compiler, which is announced.

    It lies where compiled CPU kernels do (`cpu_cache`).

    Attributes:
        name: of the kernel.
    """

    def __init__(self, function: Callable[..., None], name: str, signature: tuple[Any, ...]) -> None:
        self.name = name
        self._function = function
        self._signature = signature

    def machine_code(self, capability: tuple[int, int]) -> MachineCode:
        """The kernel for a compute capability (major, minor), compiled unless the disk has it."""
        folders, key = KernelFiles(self._function), self.key(capability)
        files = folders.files(self._function)
        found = kept_data(files, key)
        # Another process may have written its own kernel under the same name at the same time.
        if found is not None and found[:2] == (key, hashlib.sha256(found[3]).digest()):
            return MachineCode(*found[2:])
        with announced_compilation(self.name, "this GPU"):
            made = compile_kernel(self._function, self._signature, capability)
        try:
            folders.locator.ensure_cache_path()
            keep_data(files[0], key, (key, hashlib.sha256(made.cubin).digest(), *made))
        except OSError as error:
            folders.not_kept(error)
        else:
            folders.remark()
        return made

    def key(self, capability: tuple[int, int]) -> str:
        """Digest of the kernel's code and that of all functions it uses, its types, and whatever compiles it."""
        return fingerprint(self._function, f"{self._signature} {capability} {compiler_versions()}")


SLOT = 8
"""Bytes that each argument has to itself."""


class LoadedKernel:
    """A kernel in the memory of one GPU.

    Attributes:
        name: of the kernel.
    """

    def __init__(self, code: MachineCode, name: str, index: int, layout: struct.Struct) -> None:
        """Loads machine code.

        Args:
            code: for the GPU.
            name: of the kernel.
            index: of the GPU, as torch counts.
            layout: how the arguments lie in memory, each at the beginning of a slot.
        """
        self.name = name
        with current_gpu(index):
            self._context = driver.CUcontext(int(check_driver("cuCtxGetCurrent", driver.cuCtxGetCurrent())))
            self._library = ObjectCode.from_cubin(code.cubin, name=name)
            self._function = driver.CUfunction(int(self._library.get_kernel(code.entry).handle))
        self._layout, self._memory = layout, ctypes.create_string_buffer(layout.size)
        first = ctypes.addressof(self._memory)
        self._slots = (ctypes.c_void_p * (layout.size // SLOT))(*range(first, first + layout.size, SLOT))
        self._address = ctypes.addressof(self._slots)
        # The threads of a backward pass launch too, and the driver reads the arguments while others may run.
        self._lock = threading.Lock()

    def launch(self, blocks: int, threads: int, stream: int, values: list[Any]) -> None:
        """Queues the kernel.

        Args:
            blocks: how many of them.
            threads: in each block.
            stream: the address of a stream of the GPU's primary context.
            values: what the slots hold.
        """
        with self._lock:
            self._layout.pack_into(self._memory, 0, *values)
            # A thread that has not used the GPU yet has no context, and one may be busy with another GPU.
            current = check_driver("cuCtxGetCurrent", driver.cuCtxGetCurrent())
            elsewhere = int(current) != int(self._context)
            if elsewhere:
                check_driver("cuCtxPushCurrent", driver.cuCtxPushCurrent(self._context))
            try:
                done = driver.cuLaunchKernel(
                    self._function, blocks, 1, 1, threads, 1, 1, 0, stream, self._address, 0
                )  # fmt: skip
            finally:
                if elsewhere:
                    check_driver("cuCtxPopCurrent", driver.cuCtxPopCurrent())
            check_driver(self.name, done)


def current_gpu(index: int) -> Any:
    """A block in which a GPU's primary context, the one that torch uses too, is the current one."""
    return cuda.gpus[index]


def check_driver(what: str, answer: tuple[Any, ...]) -> Any:
    """Result of a call to the driver; raises if it failed.

    Raises:
        RuntimeError: the driver refused; the message names the call and the driver's error.
    """
    if answer[0] != 0:
        raise RuntimeError(f"{what} failed on the GPU: {answer[0].name}")
    return answer[1] if len(answer) > 1 else None


# Small launches are part of every frame (few cameras, few panes), and Numba warns of each of them.
config.CUDA_LOW_OCCUPANCY_WARNINGS = 0

SCALARS = {
    "bool": types.boolean,
    "byte": types.uint8,
    "short": types.int16,
    "int": types.int32,
    "long": types.int64,
    "float": types.float32,
    "double": types.float64,
}
FORMATS = {"bool": "?", "uint8": "B", "int16": "h", "int32": "i", "int64": "q", "float32": "f", "float64": "d"}
"""How numbers are written to memory."""
TOKEN = re.compile(r"([a-z]+)([1-4]?)")


class Kernel:
    """A CUDA kernel, read from the disk or compiled at its first launch on each GPU.

    Attributes:
        name: the operation and direction, such as `composite_forward_float32`.
        function: the kernel before compilation.
        signature: the Numba types of its arguments.
    """

    def __init__(self, function: Callable[..., None], name: str, signature: tuple[Any, ...]) -> None:
        self.name = name
        self.function = function
        self.signature = signature
        self._expected = [Expected(type_) for type_ in signature]
        self._loaded: dict[int, LoadedKernel] = {}
        self._layout = struct.Struct("<" + "".join(expected.layout for expected in self._expected))
        self._images = ImageCache(function, name, signature)
        self._simulated = cuda.jit(function) if SIMULATED else None

    def __call__(self, blocks: int, threads: int, *arguments: Any) -> None:
        """Launches on torch's current stream of the device of the first tensor; does nothing for no blocks.

        Args:
            blocks: how many of them.
            threads: in each block.
            arguments: contiguous tensors of one device, and numbers, in the order of the signature. None stands for
                an array without elements.
        """
        if blocks == 0:
            return
        if len(arguments) != len(self.signature):
            raise TypeError(f"{self.name} takes {len(self.signature)} arguments, got {len(arguments)}")
        if self._simulated is not None:
            values_of = (e.simulate(argument) for e, argument in zip(self._expected, arguments, strict=True))
            self._simulated[blocks, threads](*values_of)
            return
        index = next(argument.get_device() for argument in arguments if isinstance(argument, Tensor))
        values: list[Any] = []
        for argument, expected in zip(arguments, self._expected, strict=True):
            expected.append(values, argument)
        loaded = self._loaded.get(index) or self._on_device(index)
        loaded.launch(blocks, threads, torch.cuda.current_stream(index).cuda_stream, values)

    def _on_device(self, index: int) -> LoadedKernel:
        """The kernel on a GPU, loaded at first use."""
        if index not in self._loaded:
            # Numba asks the current GPU about itself while it compiles, and torch's threads may have none.
            with current_gpu(index):
                code = self._images.machine_code(torch.cuda.get_device_capability(index))
                self._loaded[index] = LoadedKernel(code, self.name, index, self._layout)
        return self._loaded[index]


@lru_cache(maxsize=4096)
def _array_layout(shape: tuple[int, ...], size: int) -> tuple[int, tuple[int, ...]]:
    """The number of an array's elements, each of so many bytes, and what stands after its address: shape, strides."""
    strides = tuple(math.prod(shape[axis + 1 :]) * size for axis in range(len(shape)))
    return math.prod(shape), (*shape, *strides)


class Expected:
    """Expected argument of a kernel, and how it is handed over.

    Attributes:
        type: the Numba type.
        layout: how what stands for an argument lies in memory, eight bytes for each value.
    """

    def __init__(self, type_: Any) -> None:
        self.type = type_
        self._is_array = isinstance(type_, types.Array)
        self._ndim = type_.ndim if self._is_array else 0
        element = str(type_.dtype if self._is_array else type_)
        self._dtype = torch.bool if element == "bool" else getattr(torch, element)
        self._is_bool = element == "bool"
        self._size = self._dtype.itemsize
        self._nothing = (0, 0, 0, self._size, 0, *(0,) * (2 * self._ndim))
        self.layout = f"{5 + 2 * self._ndim}q" if self._is_array else f"{FORMATS[element]}{8 - self._size}x"

    def append(self, values: list[Any], argument: Any) -> None:
        """Adds what stands for an argument in Numba's calling convention to the values of a launch."""
        if not self._is_array:
            values.append(argument)
            return
        if argument is None:
            values += self._nothing
            return
        shape = argument.shape
        if argument.dtype != self._dtype or len(shape) != self._ndim or not argument.is_contiguous():
            raise TypeError(f"got {argument.dtype} of shape {tuple(shape)}, expected contiguous {self.type}")
        count, after = _array_layout(shape, self._size)
        # Two pointers that only host memory uses come first.
        values += (0, 0, count, self._size, argument.data_ptr(), *after)

    def simulate(self, argument: Any) -> Any:
        """Stand-in for an argument in the simulator."""
        if not self._is_array:
            return bool(argument) if self._is_bool else np.dtype(str(self.type)).type(argument)
        if argument is None:
            return np.empty((0,) * self.type.ndim, np.dtype(str(self.type.dtype)))
        array = argument.detach().numpy()
        if argument.dtype != self._dtype or array.ndim != self.type.ndim or not array.flags.c_contiguous:
            raise TypeError(f"got {array.dtype} of shape {array.shape}, expected contiguous {self.type}")
        return array


def kernel(name: str, real: type, arguments: str) -> Callable[[Callable[..., None]], Kernel]:
    """Declares a kernel function made by a factory for one floating-point type.

    Args:
        name: the operation and direction, such as `composite_forward`.
        real: `np.float32` or `np.float64`.
        arguments: the type of each argument: `bool`, `byte`, `short`, `int`, `long`, `float`, `double` or `real`, with
            a digit for a C-contiguous array of so many dimensions: `"real2 int1 real"`.
    """
    full_name = f"{name}_{np.dtype(real).name}"

    def decorate(function: Callable[..., None]) -> Kernel:
        function.__name__ = full_name
        function.__qualname__ = full_name
        return Kernel(function, full_name, tuple(_numba_type(token, real) for token in arguments.split()))

    return decorate


def blocks_for(items: int, threads: int) -> int:
    """Blocks of so many threads that have a thread for each item."""
    return -(-items // threads)


def _numba_type(token: str, real: type) -> Any:
    match = TOKEN.fullmatch(token)
    if match is None:
        raise ValueError(f"{token!r} is no argument type; expected something like real, int1 or bool3")
    scalar = types.float32 if real is np.float32 else types.float64
    element = scalar if match[1] == "real" else SCALARS[match[1]]
    return types.Array(element, int(match[2]), "C") if match[2] else element
