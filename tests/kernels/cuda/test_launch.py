"""Marshalling of kernel arguments, compared with Numba's own."""

from __future__ import annotations

import ctypes
import struct
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("numba_cuda", reason="numba-cuda is not installed; `make setup` installs it")

from cuda.bindings.driver import CUresult
from numba import types

from glassplat.kernels.backend.cuda import Expected, ImageCache, Kernel, MachineCode, blocks_for, kernel
from glassplat.kernels.backend.devices import SIMULATED

if SIMULATED:
    pytest.skip("the simulator launches nothing", allow_module_level=True)

from numba.cuda.args import ArgHint
from numba.cuda.dispatcher import _Kernel

from glassplat.kernels.backend import cuda as launch
from glassplat.kernels.backend.cuda import SLOT


class OnDevice(ArgHint):
    """Stands in for an array on a GPU."""

    def __init__(self, array: Any, address: int) -> None:
        self.array, self.address = array, address

    def to_device(self, retr: Any, stream: int = 0) -> Any:
        layout = SimpleNamespace(strides_in_bytes=self.array.strides)
        return SimpleNamespace(
            size=self.array.size, dtype=self.array.dtype, ptr=self.address, shape=self.array.shape, _layout=layout
        )


def numbas_values(type_: Any, value: Any) -> list[Any]:
    found: list[Any] = []
    _Kernel._prepare_args(SimpleNamespace(extensions=[]), type_, value, 0, [], found)
    return found


class Driver:
    """Stands in for the driver: records each call, and reads the arguments of a launch as a GPU's driver would."""

    CUcontext, CUfunction = int, int

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.launches: list[tuple[Any, ...]] = []
        self.contexts = [OWN]
        self.refusal = 0
        self.slots = SLOTS

    def cuCtxGetCurrent(self) -> tuple[int, int]:  # noqa: N802
        self.calls.append("get")
        return 0, self.contexts[-1]

    def cuCtxPushCurrent(self, context: int) -> tuple[int]:  # noqa: N802
        self.calls.append("push")
        self.contexts.append(context)
        return (0,)

    def cuCtxPopCurrent(self) -> tuple[int, int]:  # noqa: N802
        self.calls.append("pop")
        return 0, self.contexts.pop()

    def cuLaunchKernel(self, *arguments: int) -> tuple[Any]:  # noqa: N802
        self.calls.append("launch")
        *head, slots, _ = arguments
        pointers = (ctypes.c_void_p * self.slots).from_address(slots)
        self.launches.append((self.contexts[-1], *head, *(ctypes.string_at(pointer, SLOT) for pointer in pointers)))
        return (CUresult(self.refusal),)


OWN, OTHER, SLOTS, STREAM = 11, 22, 11, 4660
"""Two contexts, the number of slots of a two-dimensional array and two numbers, and a stream."""


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Driver:
    """A stand-in for a GPU that accepts every launch."""
    found = Driver()
    library = SimpleNamespace(get_kernel=lambda entry: SimpleNamespace(handle=77))
    monkeypatch.setattr(launch, "driver", found)
    monkeypatch.setattr(launch, "ObjectCode", SimpleNamespace(from_cubin=lambda cubin, name: library))
    monkeypatch.setattr(launch, "current_gpu", lambda index: nullcontext())
    monkeypatch.setattr(torch.Tensor, "get_device", lambda tensor: 0)
    monkeypatch.setattr(torch._C, "_cuda_getCurrentRawStream", lambda index: STREAM, raising=False)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (9, 0))
    monkeypatch.setattr(ImageCache, "machine_code", lambda images, capability: MachineCode("entry", b"cubin"))
    return found


def handed_over(gpu: Driver, type_: Any, value: Any) -> list[bytes]:
    """The slots of a launch for an argument of that type, passed between two arrays without elements."""
    nothing, before, behind = types.Array(types.int16, 1, "C"), 7, 7
    gpu.slots = before + behind + (5 + 2 * type_.ndim if isinstance(type_, types.Array) else 1)
    made = Kernel(lambda first, argument, last: None, "nothing", (nothing, type_, nothing))
    made(1, 32, torch.zeros(0, dtype=torch.int16), value, None)
    return list(gpu.launches[-1][10 + before : -behind])


@pytest.mark.parametrize(
    ("dtype", "element"),
    [
        (torch.float32, types.float32),
        (torch.float64, types.float64),
        (torch.int16, types.int16),
        (torch.int32, types.int32),
        (torch.int64, types.int64),
        (torch.bool, types.boolean),
    ],
)
@pytest.mark.parametrize("shape", [(3,), (2, 3), (1, 4, 1), (2, 1, 3, 2)])
def test_arrays_are_handed_over_as_numba_does(
    gpu: Driver, dtype: torch.dtype, element: Any, shape: tuple[int, ...]
) -> None:
    tensor = torch.zeros(shape, dtype=dtype)
    type_ = types.Array(element, len(shape), "C")
    numbas = numbas_values(type_, OnDevice(np.zeros(shape, tensor.numpy().dtype), tensor.data_ptr()))
    assert [int.from_bytes(slot, "little") for slot in handed_over(gpu, type_, tensor)] == numbas


@pytest.mark.parametrize(
    ("type_", "value"),
    [(types.int32, 7), (types.int64, -3), (types.float32, 0.1), (types.float64, 0.1), (types.boolean, True)],
)
def test_numbers_are_handed_over_as_numba_does(gpu: Driver, type_: Any, value: Any) -> None:
    (slot,) = handed_over(gpu, type_, value)
    (numbas,) = numbas_values(type_, value)
    assert slot.startswith(bytes(numbas) if isinstance(numbas, ctypes._SimpleCData) else struct.pack("?", numbas))


@pytest.mark.parametrize("ndim", [1, 3])
def test_none_stands_for_an_array_without_elements(gpu: Driver, ndim: int) -> None:
    tensor, type_ = torch.zeros((0,) * ndim), types.Array(types.float32, ndim, "C")
    given, own = handed_over(gpu, type_, tensor), handed_over(gpu, type_, None)
    assert own[:4] == given[:4]
    assert int.from_bytes(own[4], "little") == tensor.data_ptr() == 0
    # Without elements no stride is ever used: shapes agree, strides do not matter.
    assert own[5 : 5 + ndim] == given[5 : 5 + ndim] == [bytes(SLOT)] * ndim


def declared() -> Any:
    """A kernel that is never compiled."""
    return kernel("nothing", np.float32, "real2 int bool")(lambda values, count, flag: None)


def test_a_launch_hands_the_driver_every_argument_in_a_slot_of_its_own(gpu: Driver) -> None:
    values = torch.zeros(3, 2)
    declared()(5, 64, values, -7, True)
    ((context, function, *sizes, stream), slots) = gpu.launches[0][:10], gpu.launches[0][10:]
    assert (context, function, stream) == (OWN, 77, STREAM)
    assert sizes == [5, 1, 1, 64, 1, 1, 0]
    assert [int.from_bytes(slot, "little") for slot in slots[:9]] == [0, 0, 6, 4, values.data_ptr(), 3, 2, 8, 4]
    assert slots[9].startswith(struct.pack("<i", -7))
    assert slots[10].startswith(b"\x01")


def test_a_launch_takes_two_calls_of_the_driver_and_no_new_memory(gpu: Driver) -> None:
    made, values = declared(), torch.zeros(3, 2)
    made(5, 64, values, 1, True)
    gpu.calls.clear()
    loaded = made._on_device(0)
    memory = loaded._address
    for _ in range(3):
        made(5, 64, values, 1, True)
    assert gpu.calls == ["get", "launch"] * 3
    assert made._on_device(0) is loaded
    assert loaded._address == memory


def test_a_thread_without_the_gpus_context_borrows_it(gpu: Driver) -> None:
    made, values = declared(), torch.zeros(3, 2)
    made(5, 64, values, 1, True)
    gpu.contexts[:] = [OTHER]
    gpu.calls.clear()
    made(5, 64, values, 1, True)
    assert gpu.calls == ["get", "push", "launch", "pop"]
    assert gpu.launches[-1][0] == OWN
    assert gpu.contexts == [OTHER]


def test_errors_of_the_driver_are_named(gpu: Driver) -> None:
    gpu.refusal = 701
    with pytest.raises(RuntimeError, match=r"nothing_float32 failed on the GPU: CUDA_ERROR_LAUNCH_OUT_OF_RESOURCES"):
        declared()(5, 64, torch.zeros(3, 2), 1, True)


def test_shapes_of_one_launch_are_not_those_of_the_next(gpu: Driver) -> None:
    gpu.slots = 18
    made = kernel("nothing", np.float32, "real2 real2")(lambda first, second: None)
    for shape in [(3, 2), (3, 2), (5, 2), None, None, (5, 2), (0, 2), (3, 2)]:
        made(1, 32, torch.zeros(1, 1), None if shape is None else torch.zeros(shape))
        first, second = gpu.launches[-1][10:19], gpu.launches[-1][19:28]
        rows, columns = shape or (0, 0)
        assert [int.from_bytes(first[i], "little") for i in (2, 3, 5, 6, 7, 8)] == [1, 4, 1, 1, 4, 4]
        assert [int.from_bytes(second[i], "little") for i in (2, 3, 5, 6)] == [rows * columns, 4, rows, columns]
        if shape is not None:
            assert [int.from_bytes(second[i], "little") for i in (7, 8)] == [4 * columns, 4]


@pytest.mark.parametrize(
    "tensor",
    [torch.zeros(2, 3, dtype=torch.float64), torch.zeros(3), torch.zeros(3, 2).T],
    ids=["type", "rank", "order"],
)
def test_unsupported_kernel_arguments_are_refused(gpu: Driver, tensor: torch.Tensor) -> None:
    with pytest.raises(TypeError, match="expected contiguous array"):
        declared()(1, 32, tensor, 1, True)
    assert gpu.launches == []
    with pytest.raises(TypeError, match="expected contiguous array"):
        Expected.of(types.Array(types.float32, 2, "C")).simulate(tensor)


def test_a_wrong_argument_list_is_refused() -> None:
    with pytest.raises(ValueError, match="'real7' is not an argument type"):
        kernel("nothing", np.float32, "real7")(lambda values: None)
    made = kernel("nothing", np.float32, "real1 int")(lambda values, count: None)
    assert made.name == "nothing_float32"
    made(0, 32)
    with pytest.raises(TypeError, match="takes 2 arguments, got 1"):
        made(1, 32, torch.zeros(3))


def test_blocks_cover_all_items() -> None:
    assert [blocks_for(items, 128) for items in (0, 1, 128, 129)] == [0, 1, 1, 2]


def test_a_launch_over_items_has_a_thread_for_each(monkeypatch: pytest.MonkeyPatch) -> None:
    @kernel("fill", np.float32, "real1")
    def fill(values):
        values[0] = 1

    launches: list[tuple[Any, ...]] = []
    monkeypatch.setattr(Kernel, "__call__", lambda self, *arguments: launches.append(arguments))
    fill.over(129, None)
    fill.over(129, None, threads=256)
    fill.over(0, None)
    assert launches == [(2, 128, None), (1, 256, None), (0, 128, None)]
