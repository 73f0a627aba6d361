"""A stand-in for a GPU that counts what the program would wait for: on the CPU, where nothing waits."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from glassplat.kernels.backend import devices
from glassplat.scene import camera
from glassplat.scene.panes import Planes
from glassplat.training import densify
from tests.kernels.test_screen_statistics import add_views_in_torch

ATEN = torch.ops.aten
LOOKED_AT = {ATEN._local_scalar_dense.default, ATEN.nonzero.default, ATEN.masked_select.default, ATEN.equal.default}
"""Operations that return a number to the program, or a size that depends on numbers."""
FROM_HERE = {ATEN.lift_fresh.default}
"""Operations that turn the program's numbers into a tensor."""
INDEXED = {ATEN.index.Tensor, ATEN.index_put_.default, ATEN.index_put.default, ATEN._index_put_impl_.default}
READ = {torch.Tensor.tolist, torch.Tensor.numpy, torch.Tensor.cpu}
KERNEL_WAITS = {"bin_tiles": 1, "trace_gradients": 1}
"""Number of waits of these functions of CUDA kernels; the others never wait (`test_waiting.py` checks it)."""


class Waits(TorchDispatchMode):
    """Records where the package would wait for a GPU, including blocking copies to it, and which kernels run."""

    def __init__(self) -> None:
        super().__init__()
        self.places: list[str] = []
        self.asked: set[str] = set()
        self.pauses = 0
        self.reads = Reads(self)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Suspends recording."""
        self.pauses += 1
        try:
            yield
        finally:
            self.pauses -= 1

    def note(self, what: str) -> None:
        if self.pauses:
            return
        frame = sys._getframe(1)
        while frame.f_back is not None and "/glassplat/" not in frame.f_code.co_filename:
            frame = frame.f_back
        if "/glassplat/" in frame.f_code.co_filename:
            path = frame.f_code.co_filename.rpartition("/glassplat/")[2]
            self.places.append(f"{path}:{frame.f_lineno} {what}")

    def __torch_dispatch__(
        self, function: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        by_mask = function in INDEXED and any(t is not None and t.dtype == torch.bool for t in args[1])
        if by_mask or function in LOOKED_AT or (function in FROM_HERE and args[0].device.type == "cpu"):
            self.note(str(function))
        return function(*args, **(kwargs or {}))

    def __enter__(self) -> Waits:
        self.reads.__enter__()
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self.reads.__exit__(*error)


class Reads(TorchFunctionMode):
    """Records reads that never reach the dispatcher: conversions of tensors to lists or arrays."""

    def __init__(self, waits: Waits) -> None:
        super().__init__()
        self.waits = waits

    def __torch_function__(
        self, function: Callable[..., Any], types: Sequence[type], args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        if function not in READ:
            return function(*args, **(kwargs or {}))
        self.waits.note(function.__name__)
        with self.waits.paused():
            return function(*args, **(kwargs or {}))


def mirrored_views(centers: Tensor, raw_normals: Tensor, pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Stands in for the kernel of that name, which exists only for GPUs."""
    normals = torch.nn.functional.normalize(raw_normals, dim=1)
    eye = -pose[:3, :3].T @ pose[:3, 3]
    facing = normals * ((eye - centers) * normals).sum(1, keepdim=True).sign()
    half_spaces = torch.cat([facing, -(facing * centers).sum(1, keepdim=True)], dim=1)
    return pose @ camera.mirror_matrices(centers, normals), normals @ pose[:3, :3].T, half_spaces


def mirrored_views_gradients(*tensors: Tensor) -> tuple[Tensor, ...]:
    *inputs, v_poses, v_normals = tensors
    with torch.enable_grad():
        leaves = [tensor.clone().requires_grad_() for tensor in inputs]
        return torch.autograd.grad(mirrored_views(*leaves)[:2], leaves, [v_poses, v_normals])


def panes_in_camera(
    centers: Tensor, raw_normals: Tensor, tangents: Tensor, pose: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Stands in for the kernel of that name."""
    rest = centers[:, 0], tangents, centers[:, :2], tuple(range(1, 1 + len(centers)))
    planes, rotation = Planes(centers, raw_normals, *rest), pose[:3, :3]
    return centers @ rotation.T + pose[:3, 3], planes.normals @ rotation.T, torch.stack(planes.axes(), 1) @ rotation.T


GPU_ONLY = {"panes": (mirrored_views, mirrored_views_gradients, panes_in_camera)}


def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch, waits: Waits) -> None:
    """Makes the program choose as on a GPU, count the waits of its kernels, and copy without waiting."""
    module_of = devices._module

    def counted(operation: str, folder: str) -> SimpleNamespace:
        known = {**vars(module_of(operation, folder)), **{one.__name__: one for one in GPU_ONLY.get(operation, ())}}

        def run(name: str) -> Callable[..., Any]:
            def call(*args: Any, **kwargs: Any) -> Any:
                waits.asked.add(name)
                waits.places += [f"kernel {name}"] * KERNEL_WAITS.get(name, 0)
                with waits.paused():
                    return known[name](*args, **kwargs)

            return call

        return SimpleNamespace(**{name: run(name) for name, value in known.items() if callable(value)})

    monkeypatch.setattr(devices, "_module", counted)
    # On a CPU its kernel is not requested.
    monkeypatch.setattr(densify, "add_views", add_views_in_torch)
    # The code of the function is replaced because other modules import it by name.
    monkeypatch.setattr(camera.synchronises, "__code__", (lambda device: True).__code__)
