"""How arguments are handed to a kernel, against Numba's own way of doing it."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("numba_cuda", reason="numba-cuda is not installed; `make setup` installs it")

from numba import types

from glassplat.kernels.cuda.launch import Expected, blocks_for, kernel
from glassplat.kernels.devices import SIMULATED

if SIMULATED:
    pytest.skip("the simulator launches nothing", allow_module_level=True)

from numba.cuda.args import ArgHint
from numba.cuda.dispatcher import _Kernel


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


def plain(values: list[Any]) -> list[Any]:
    return [(type(v).__name__, v.value) if isinstance(v, ctypes._SimpleCData) else v for v in values]


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
def test_arrays_are_handed_over_as_numba_does(dtype: torch.dtype, element: Any, shape: tuple[int, ...]) -> None:
    tensor, own = torch.zeros(shape, dtype=dtype), []
    type_ = types.Array(element, len(shape), "C")
    Expected(type_).append(own, tensor)
    assert own == numbas_values(type_, OnDevice(np.zeros(shape, tensor.numpy().dtype), tensor.data_ptr()))


@pytest.mark.parametrize(
    ("type_", "value"),
    [(types.int32, 7), (types.int64, -3), (types.float32, 0.1), (types.float64, 0.1), (types.boolean, True)],
)
def test_numbers_are_handed_over_as_numba_does(type_: Any, value: Any) -> None:
    own: list[Any] = []
    Expected(type_).append(own, value)
    assert plain(own) == plain(numbas_values(type_, value))


@pytest.mark.parametrize(
    "tensor",
    [torch.zeros(2, 3, dtype=torch.float64), torch.zeros(3), torch.zeros(3, 2).T],
    ids=["type", "rank", "order"],
)
def test_what_a_kernel_does_not_take_is_refused(tensor: torch.Tensor) -> None:
    with pytest.raises(TypeError, match="expected contiguous array"):
        Expected(types.Array(types.float32, 2, "C")).append([], tensor)


def test_a_wrong_argument_list_is_refused() -> None:
    with pytest.raises(ValueError, match="'real7' is no argument type"):
        kernel("nothing", np.float32, "real7")(lambda values: None)
    declared = kernel("nothing", np.float32, "real1 int")(lambda values, count: None)
    assert declared.name == "nothing_float32"
    declared(0, 32)
    with pytest.raises(TypeError, match="takes 2 arguments, got 1"):
        declared(1, 32, torch.zeros(3))


def test_blocks_cover_all_items() -> None:
    assert [blocks_for(items, 128) for items in (0, 1, 128, 129)] == [0, 1, 1, 2]
