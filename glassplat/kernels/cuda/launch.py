"""How CUDA kernels are declared, compiled and launched: one place for the flags and for what torch and Numba share.

Memory, sorting and scans belong to torch; a kernel gets views of its tensors and runs on its current stream.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numba import config, cuda, types
from torch import Tensor

from glassplat.kernels.devices import SIMULATED

log = logging.getLogger("glassplat.kernels")

# Small launches are part of every frame (few cameras, few panes), and Numba warns of each of them.
config.CUDA_LOW_OCCUPANCY_WARNINGS = 0

SCALARS = {
    "bool": types.boolean,
    "short": types.int16,
    "int": types.int32,
    "long": types.int64,
    "float": types.float32,
    "double": types.float64,
}
TOKEN = re.compile(r"([a-z]+)([1-4]?)")


class Kernel:
    """A CUDA kernel, compiled at its first launch for each compute capability.

    Attributes:
        name: the operation and direction, such as `composite_forward_float32`.
        function: the kernel before compilation.
        signature: the Numba types of its arguments.
        bounds: threads of a block, and how many blocks a multiprocessor should hold at once; caps the registers.
    """

    def __init__(
        self, function: Callable[..., None], name: str, signature: tuple[Any, ...], bounds: tuple[int, int] | None
    ) -> None:
        self.name = name
        self.function = function
        self.signature = signature
        self.bounds = bounds
        # The simulator knows no bounds.
        self.dispatcher = cuda.jit(function) if SIMULATED else cuda.jit(function, launch_bounds=bounds)

    def __call__(self, blocks: int, threads: int, *arguments: Any) -> None:
        """Launches on torch's current stream of the device of the first tensor; does nothing for no blocks.

        Args:
            blocks: how many of them.
            threads: in each block.
            arguments: contiguous tensors of one device, and numbers, in the order of the signature.
        """
        if blocks == 0:
            return
        if len(arguments) != len(self.signature):
            raise TypeError(f"{self.name} takes {len(self.signature)} arguments, got {len(arguments)}")
        if SIMULATED:
            self.dispatcher[blocks, threads](*map(_simulated, arguments, self.signature))
            return
        device = next(argument.device for argument in arguments if isinstance(argument, Tensor))
        # Numba keeps a current device of its own; torch's may have changed.
        with cuda.gpus[device.index]:
            self._announce_compilation()
            handle = torch.cuda.current_stream(device).cuda_stream
            stream = cuda.external_stream(handle) if handle else 0
            self.dispatcher[blocks, threads, stream](*map(_on_device, arguments, self.signature))

    def _announce_compilation(self) -> None:
        if self.dispatcher.overloads:
            return
        log.info("compiling %s for this GPU (first use only) ...", self.name)
        started = time.perf_counter()
        self.dispatcher.compile(self.signature)
        log.info("compiled %s in %.1f s", self.name, time.perf_counter() - started)


def kernel(
    name: str, real: type, arguments: str, *, bounds: tuple[int, int] | None = None
) -> Callable[[Callable[..., None]], Kernel]:
    """Declares a kernel function made by a factory for one floating-point type.

    Args:
        name: the operation and direction, such as `composite_forward`.
        real: `np.float32` or `np.float64`.
        arguments: the type of each argument: `bool`, `short`, `int`, `long`, `float`, `double` or `real`, with a digit
            for a C-contiguous array of so many dimensions: `"real2 int1 real"`.
        bounds: threads of a block, and how many blocks a multiprocessor should hold at once.
    """
    full_name = f"{name}_{np.dtype(real).name}"

    def decorate(function: Callable[..., None]) -> Kernel:
        function.__name__ = full_name
        function.__qualname__ = full_name
        return Kernel(function, full_name, tuple(_numba_type(token, real) for token in arguments.split()), bounds)

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


def _on_device(argument: Any, expected: Any) -> Any:
    if isinstance(argument, Tensor):
        return cuda.as_cuda_array(argument.detach(), sync=False)
    return _number(argument, expected)


def _simulated(argument: Any, expected: Any) -> Any:
    if isinstance(argument, Tensor):
        array = argument.detach().numpy()
        if str(array.dtype) != str(expected.dtype) or array.ndim != expected.ndim or not array.flags.c_contiguous:
            raise TypeError(f"got {array.dtype} of shape {array.shape}, expected contiguous {expected}")
        return array
    return _number(argument, expected)


def _number(argument: Any, expected: Any) -> Any:
    """A number of exactly the expected type, so that no other signature is compiled."""
    if expected == types.boolean:
        return bool(argument)
    return np.dtype(str(expected)).type(argument)
