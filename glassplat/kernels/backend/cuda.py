"""Declaration, compilation and launch of CUDA kernels: compiler flags, and the interface of torch and Numba.

torch does memory, sorting and scans; a kernel gets views of its tensors and runs on its current stream. Numba's own
launch spends microseconds on each array; here the arguments are packed directly in its calling convention.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import math
import re
import struct
import threading
from collections.abc import Callable, Sequence
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

from glassplat.kernels.backend.cpu_cache import KernelFiles, fingerprint, load_data
from glassplat.kernels.backend.devices import SIMULATED, announce_compilation

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
"""Distributions whose versions affect the compiled code."""


class MachineCode(NamedTuple):
    """A kernel for one compute capability: its name in the cubin, and the cubin."""

    entry: str
    cubin: bytes


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
    """Machine code of one kernel: from the disk, or from the compiler, with an announcement.

    It is stored in the same folders as compiled CPU kernels (`cpu_cache`).

    Attributes:
        name: of the kernel.
    """

    def __init__(self, function: Callable[..., None], name: str, signature: tuple[Any, ...]) -> None:
        self.name = name
        self._function = function
        self._signature = signature

    def machine_code(self, capability: tuple[int, int]) -> MachineCode:
        """The kernel for a compute capability (major, minor), compiled unless it is on disk."""
        folders, key = KernelFiles(self._function), self.key(capability)
        files = folders.files(self._function)
        found = load_data(files, key)
        # Another process may have written its own kernel under the same name at the same time.
        if found is not None and found[0] == key and found[1] == hashlib.sha256(found[3]).digest():
            return MachineCode(*found[2:])
        with announce_compilation(self.name, "this GPU"):
            text, _ = cuda.compile(
                self._function, self._signature, device=False, abi="numba", cc=capability, debug=False, opt=True
            )
            (entry,) = ENTRY.findall(text)
            options = LinkerOptions(arch=f"sm_{capability[0]}{capability[1]}")
            linked = Linker(ObjectCode.from_ptx(text.encode()), options=options).link("cubin")
            made = MachineCode(entry, bytes(linked.code))
        folders.store(files[0], key, (key, hashlib.sha256(made.cubin).digest(), *made))
        return made

    def key(self, capability: tuple[int, int]) -> str:
        """Digest of the code of the kernel and all functions it uses, its argument types, and the compiler versions."""
        return fingerprint(self._function, f"{self._signature} {capability} {compiler_versions()}")


SLOT = 8
"""Bytes reserved for each argument."""


class LoadedKernel:
    """A kernel in the memory of one GPU.

    Attributes:
        name: of the kernel.
    """

    def __init__(self, code: MachineCode, name: str, index: int, expected: Sequence[Expected]) -> None:
        """Loads machine code into the memory of the GPU with this index in torch's numbering."""
        self.name = name
        with current_gpu(index):
            self._context = int(check_driver("cuCtxGetCurrent", driver.cuCtxGetCurrent()))
            self._library = ObjectCode.from_cubin(code.cubin, name=name)
            self._function = driver.CUfunction(int(self._library.get_kernel(code.entry).handle))
        # Addresses and numbers come first, then a zero, then sizes and strides of the arrays, which seldom change.
        self._front = struct.Struct("<" + "".join(one.layout for one in expected))
        zero, behind = len(expected), len(expected) + 1
        places: list[int] = []
        self._sizes: list[tuple[struct.Struct, int, int]] = []
        for place, (_, dtype, ndim, size) in enumerate(expected):
            if dtype is None:
                places.append(place)
                continue
            count, each, *others = range(behind, behind + 2 + 2 * ndim)
            # The first two pointers are used for host memory only.
            places += (zero, zero, count, each, place, *others)
            self._sizes.append((struct.Struct(f"<{2 + 2 * ndim}q"), behind * SLOT, size))
            behind += 2 + 2 * ndim
        self._shapes: Sequence[tuple[int, ...] | None] = [()] * len(self._sizes)
        self._memory = ctypes.create_string_buffer(behind * SLOT)
        first = ctypes.addressof(self._memory)
        self._slots = (ctypes.c_void_p * len(places))(*(first + place * SLOT for place in places))
        self._address = ctypes.addressof(self._slots)
        # Threads of a backward pass launch too, and the driver reads the arguments while other threads may run.
        self._lock = threading.Lock()

    def launch(
        self, blocks: int, threads: int, stream: int, values: list[Any], shapes: list[tuple[int, ...] | None]
    ) -> None:
        """Queues the kernel.

        Args:
            blocks: number of blocks.
            threads: in each block.
            stream: the address of a stream of the GPU's primary context.
            values: the arguments; for an array, its address.
            shapes: of the arrays; None for an absent one.
        """
        with self._lock:
            self._front.pack_into(self._memory, 0, *values)
            if shapes != self._shapes:
                self._write_layouts(shapes)
            # A thread that has not used the GPU yet has no context, and another may have that of another GPU.
            current = check_driver("cuCtxGetCurrent", driver.cuCtxGetCurrent())
            elsewhere = int(current) != self._context
            if elsewhere:
                check_driver("cuCtxPushCurrent", driver.cuCtxPushCurrent(driver.CUcontext(self._context)))
            try:
                done = driver.cuLaunchKernel(
                    self._function, blocks, 1, 1, threads, 1, 1, 0, stream, self._address, 0
                )  # fmt: skip
            finally:
                if elsewhere:
                    check_driver("cuCtxPopCurrent", driver.cuCtxPopCurrent())
            check_driver(self.name, done)

    def _write_layouts(self, shapes: Sequence[tuple[int, ...] | None]) -> None:
        """Writes the fields of arrays with a new shape: number and bytes of the elements, shape, strides."""
        for shape, known, (layout, offset, size) in zip(shapes, self._shapes, self._sizes, strict=True):
            if shape == known:
                continue
            if shape is None:
                layout.pack_into(self._memory, offset, 0, size, *(0,) * (layout.size // SLOT - 2))
            else:
                layout.pack_into(self._memory, offset, math.prod(shape), size, *shape, *_strides(shape, size))
        self._shapes = shapes


@lru_cache(maxsize=1024)
def _strides(shape: tuple[int, ...], size: int) -> tuple[int, ...]:
    """Bytes from one element to the next along each dimension of a contiguous array."""
    return tuple(math.prod(shape[axis + 1 :]) * size for axis in range(len(shape)))


def current_gpu(index: int) -> Any:
    """Context manager that makes a GPU's primary context, which torch uses too, the current one."""
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
"""`struct` formats of the number types."""
TOKEN = re.compile(r"([a-z]+)([1-4]?)")
THREADS = 128
"""Threads per block of most kernels."""


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
        self._expected = [Expected.of(type_) for type_ in signature]
        self._loaded: dict[int, LoadedKernel] = {}
        self._images = ImageCache(function, name, signature)
        self._simulated = cuda.jit(function) if SIMULATED else None

    def __call__(self, blocks: int, threads: int, *arguments: Any) -> None:
        """Launches on torch's current stream of the tensors' device; does nothing for zero blocks.

        Args:
            blocks: number of blocks.
            threads: in each block.
            arguments: contiguous tensors of one device, at least one, and numbers, in the order of the signature. None
                stands for an array without elements.
        """
        if blocks == 0:
            return
        if len(arguments) != len(self.signature):
            raise TypeError(f"{self.name} takes {len(self.signature)} arguments, got {len(arguments)}")
        if self._simulated is not None:
            own = (e.simulate(argument) for e, argument in zip(self._expected, arguments, strict=True))
            self._simulated[blocks, threads](*own)
            return
        # Python takes longer for the arguments than the driver for the launch, so function calls are kept to a minimum.
        values: list[Any] = []
        shapes: list[tuple[int, ...] | None] = []
        for argument, (type_, dtype, ndim, _) in zip(arguments, self._expected, strict=True):
            if dtype is None:
                values.append(argument)
            elif argument is None:
                values.append(0)
                shapes.append(None)
            else:
                shape = argument.shape
                if argument.dtype is not dtype or len(shape) != ndim or not argument.is_contiguous():
                    raise argument_error(argument, type_)
                values.append(argument.data_ptr())
                shapes.append(shape)
                tensor = argument
        index = tensor.get_device()
        loaded = self._loaded.get(index) or self._on_device(index)
        # The raw stream handle, which `torch.cuda.current_stream` would wrap in an object.
        loaded.launch(blocks, threads, torch._C._cuda_getCurrentRawStream(index), values, shapes)

    def over(self, items: int, *arguments: Any, threads: int = THREADS) -> None:
        """Launches with one thread per item, in blocks of the given size; the last block may have surplus threads."""
        self(blocks_for(items, threads), threads, *arguments)

    def _on_device(self, index: int) -> LoadedKernel:
        """The kernel on a GPU, loaded at first use."""
        if index not in self._loaded:
            # Numba queries the current GPU while it compiles, and torch's threads may have none.
            with current_gpu(index):
                code = self._images.machine_code(torch.cuda.get_device_capability(index))
                self._loaded[index] = LoadedKernel(code, self.name, index, self._expected)
        return self._loaded[index]


class Expected(NamedTuple):
    """Expected argument of a kernel.

    Attributes:
        type: the Numba type.
        dtype: of an array; None for a number.
        ndim: dimensions of an array.
        size: bytes of a number or an element.
    """

    type: Any
    dtype: torch.dtype | None
    ndim: int
    size: int

    @classmethod
    def of(cls, type_: Any) -> Expected:
        """The expected argument for a Numba type."""
        is_array = isinstance(type_, types.Array)
        element = str(type_.dtype if is_array else type_)
        dtype: torch.dtype = torch.bool if element == "bool" else getattr(torch, element)
        return cls(type_, dtype if is_array else None, type_.ndim if is_array else 0, dtype.itemsize)

    @property
    def layout(self) -> str:
        """Format of the eight bytes that hold a number, or the address of an array."""
        return "q" if self.dtype is not None else f"{FORMATS[str(self.type)]}{SLOT - self.size}x"

    def simulate(self, argument: Any) -> Any:
        """Stand-in for an argument in the simulator."""
        if self.dtype is None:
            return bool(argument) if self.type == types.boolean else np.dtype(str(self.type)).type(argument)
        if argument is None:
            return np.empty((0,) * self.ndim, np.dtype(str(self.type.dtype)))
        if argument.dtype != self.dtype or argument.dim() != self.ndim or not argument.is_contiguous():
            raise argument_error(argument, self.type)
        return argument.detach().numpy()


def argument_error(argument: Tensor, type_: Any) -> TypeError:
    """Error for a tensor whose type, rank or layout is not the one that a kernel expects."""
    return TypeError(f"got {argument.dtype} of shape {tuple(argument.shape)}, expected contiguous {type_}")


def kernel(name: str, real: type, arguments: str) -> Callable[[Callable[..., None]], Kernel]:
    """Declares a kernel function made by a factory for one floating-point type.

    Args:
        name: the operation and direction, such as `composite_forward`.
        real: `np.float32` or `np.float64`.
        arguments: the type of each argument: `bool`, `byte`, `short`, `int`, `long`, `float`, `double` or `real`, with
            a digit for a C-contiguous array of that number of dimensions: `"real2 int1 real"`.
    """
    full_name = f"{name}_{np.dtype(real).name}"

    def decorate(function: Callable[..., None]) -> Kernel:
        function.__name__ = full_name
        function.__qualname__ = full_name
        return Kernel(function, full_name, tuple(_numba_type(token, real) for token in arguments.split()))

    return decorate


def blocks_for(items: int, threads: int) -> int:
    """Number of blocks of the given size that provide one thread per item."""
    return -(-items // threads)


def _numba_type(token: str, real: type) -> Any:
    match = TOKEN.fullmatch(token)
    if match is None:
        raise ValueError(f"{token!r} is not an argument type; expected something like real, int1 or bool3")
    scalar = types.float32 if real is np.float32 else types.float64
    element = scalar if match[1] == "real" else SCALARS[match[1]]
    return types.Array(element, int(match[2]), "C") if match[2] else element
