"""Choosing a device: accepted names, messages, and advice where a GPU cannot be used."""

from __future__ import annotations

import importlib.util
import logging
import tomllib
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

from glassplat.kernels.backend import devices
from glassplat.kernels.backend.devices import CudaUnavailableError, chosen_device, cuda_problem, kernels_for


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A machine that, according to torch, has everything a GPU needs."""
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "A GPU")
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    for name, value in {"has_numba_cuda": True, "bindings_major": 13, "driver_version": 13000}.items():
        monkeypatch.setattr(devices, name, lambda value=value: value)
    monkeypatch.setattr(devices, "has_library", lambda name: True)
    return monkeypatch


def test_auto_selects_the_gpu_and_logs_it(gpu: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        assert chosen_device("auto") == torch.device("cuda", 0)
    assert "running on A GPU" in caplog.text
    assert chosen_device(torch.device("cuda", 0)) == torch.device("cuda", 0)
    assert chosen_device("cpu") == torch.device("cpu")


@pytest.mark.parametrize("name", ["gpu", "cuda:1", "", None, 0])
def test_other_devices_are_refused(gpu: pytest.MonkeyPatch, name: Any) -> None:
    assert chosen_device(torch.device("cpu")) == torch.device("cpu")
    with pytest.raises(ValueError, match=f"device is '{name}'; expected auto, cpu or cuda"):
        chosen_device(name)


def test_a_torch_without_cuda_is_explained(gpu: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    gpu.setattr(torch.version, "cuda", None)
    gpu.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CudaUnavailableError, match="PyTorch is built without CUDA; install another build"):
        chosen_device("cuda")
    with caplog.at_level(logging.INFO):
        assert chosen_device("auto") == torch.device("cpu")
    assert "running on the CPU" in caplog.text


def test_a_missing_driver_is_explained(gpu: pytest.MonkeyPatch) -> None:
    gpu.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CudaUnavailableError, match=r"no NVIDIA GPU or driver was found.*or use --device cpu"):
        chosen_device("cuda")


def test_a_driver_that_is_too_old_is_explained(gpu: pytest.MonkeyPatch) -> None:
    def too_old() -> bool:
        warnings.warn("The NVIDIA driver on your system is too old (found version 11040). Please update", stacklevel=1)
        return False

    gpu.setattr(torch.cuda, "is_available", too_old)
    problem = cuda_problem()
    assert problem is not None
    assert "too old (found version 11040)" in problem
    assert "CUDA 13.0 is needed" in problem


def test_missing_kernels_are_explained(gpu: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    gpu.setattr(devices, "has_numba_cuda", lambda: False)
    with pytest.raises(CudaUnavailableError, match=r"pip install 'glassplat\[cuda\]'"):
        chosen_device("cuda")
    with caplog.at_level(logging.INFO):
        chosen_device("auto")
    assert "numba-cuda" in caplog.text


def test_a_gpu_that_is_too_old_is_explained(gpu: pytest.MonkeyPatch) -> None:
    gpu.setattr(torch.cuda, "get_device_capability", lambda: (6, 1))
    with pytest.raises(CudaUnavailableError, match=r"compute capability 6\.1; 7\.5 or newer"):
        chosen_device("cuda")


@pytest.mark.parametrize("driver", [13000, 13040, 14010])
def test_a_driver_at_least_as_new_as_the_compiler_is_accepted(gpu: pytest.MonkeyPatch, driver: int) -> None:
    gpu.setattr(devices, "driver_version", lambda: driver)
    assert cuda_problem() is None


def test_a_compiler_newer_than_the_driver_is_explained(
    gpu: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    gpu.setattr(torch.version, "cuda", "12.8")
    gpu.setattr(devices, "driver_version", lambda: 12040)
    with pytest.raises(CudaUnavailableError, match=r"supports CUDA 12\.4, but the kernels' compiler is for CUDA 13"):
        chosen_device("cuda")
    assert "pip install 'glassplat[cuda12]'" in str(cuda_problem())
    with caplog.at_level(logging.INFO):
        assert chosen_device("auto") == torch.device("cpu")
    assert "the NVIDIA driver supports CUDA 12.4" in caplog.text
    gpu.setattr(devices, "bindings_major", lambda: 12)
    assert cuda_problem() is None


@pytest.mark.parametrize(("major", "extra"), [(12, "glassplat[cuda12]"), (13, "glassplat[cuda]")])
@pytest.mark.parametrize("absent", ["nvvm", "nvrtc"])
def test_a_library_that_the_compiler_lacks_is_named(
    gpu: pytest.MonkeyPatch, absent: str, major: int, extra: str
) -> None:
    gpu.setattr(devices, "bindings_major", lambda: major)
    gpu.setattr(devices, "has_library", lambda name: name != absent)
    problem = str(cuda_problem())
    assert f"the kernels' compiler lacks lib{absent}; " in problem
    assert f"pip install '{extra}'" in problem


def test_missing_bindings_are_explained(gpu: pytest.MonkeyPatch) -> None:
    gpu.setattr(devices, "bindings_major", lambda: None)
    assert "not cuda-bindings" in str(cuda_problem())


@pytest.mark.skipif(importlib.util.find_spec("numba_cuda") is None, reason="numba-cuda is not installed")
def test_installed_packages_are_detected() -> None:
    assert devices.bindings_major() in (12, 13)
    assert not devices.has_library("nvfatbin") or devices.has_library("nvvm")


def test_the_extras_are_bounded_and_pair_each_pytorch_with_its_cuda() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    extras = {name: " ".join(needs) for name, needs in project["optional-dependencies"].items()}
    for extra, cuda in (("cuda", "cu13"), ("cuda12", "cu12")):
        assert f"numba-cuda[{cuda}]>=0.30.2,<0.31" in extras[extra]
        assert "cuda-core>=1.2,<2" in extras[extra]
    # PyTorch 2.10 pins the bindings of CUDA 12, with which the extra for CUDA 13 cannot be installed.
    assert "torch>=2.11" in extras["cuda"]
    assert "numba-cuda>=0.30.2,<0.31" in extras["dev"] and "cuda-core>=1.2,<2" in extras["dev"]


def test_tensors_on_a_gpu_without_its_kernels_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "has_numba_cuda", lambda: False)
    devices._module.cache_clear()
    with pytest.raises(CudaUnavailableError, match="pip install"):
        kernels_for("adam", torch.device("cuda"))
    assert kernels_for("adam", torch.device("cpu")).__name__ == "glassplat.kernels.adam.cpu"


@pytest.mark.skipif(importlib.util.find_spec("numba_cuda") is None, reason="numba-cuda is not installed")
@pytest.mark.parametrize(
    "operation",
    [
        "adam.adam",
        "composite.composite",
        "environment.cube_lookup",
        "environment.shade_environment",
        "environment.surface_channels",
        "panes.blend_panes",
        "panes.pane_hits",
        "photometric.photometric",
        "project.project",
        "tiles.bin_tiles",
        "trace.build_bvh",
        "trace.trace",
    ],
)
def test_every_operation_has_the_same_functions_on_both_devices(operation: str) -> None:
    folder, _, name = operation.partition(".")
    cpu, cuda = (kernels_for(folder, torch.device(kind)) for kind in ("cpu", "cuda"))
    own = {key for key, value in vars(cpu).items() if getattr(value, "__module__", "").startswith(cpu.__package__)}
    shared = {key for key in own if key == name or key in (f"{name}_gradient", f"{name}_gradients")}
    assert name in shared
    assert all(hasattr(cuda, key) for key in shared)
