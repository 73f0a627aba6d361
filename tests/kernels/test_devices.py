"""Choosing a device: what is taken, what is said, and what to do where a GPU cannot be used."""

from __future__ import annotations

import importlib.util
import logging
import warnings

import pytest
import torch

from glassplat.kernels import devices
from glassplat.kernels.devices import CudaUnavailableError, chosen_device, cuda_problem, kernels_for


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A machine on which everything that a GPU needs is there, as far as torch says."""
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "A GPU")
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(devices, "_has_numba_cuda", lambda: True)
    return monkeypatch


def test_auto_takes_the_gpu_and_says_so(gpu: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        assert chosen_device("auto") == torch.device("cuda", 0)
    assert "running on A GPU" in caplog.text
    assert chosen_device("cpu") == torch.device("cpu")


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
    gpu.setattr(devices, "_has_numba_cuda", lambda: False)
    with pytest.raises(CudaUnavailableError, match=r"pip install 'glassplat\[cuda\]'"):
        chosen_device("cuda")
    with caplog.at_level(logging.INFO):
        chosen_device("auto")
    assert "numba-cuda" in caplog.text


def test_a_gpu_that_is_too_old_is_explained(gpu: pytest.MonkeyPatch) -> None:
    gpu.setattr(torch.cuda, "get_device_capability", lambda: (6, 1))
    with pytest.raises(CudaUnavailableError, match=r"compute capability 6\.1; 7\.5 or newer"):
        chosen_device("cuda")


def test_tensors_on_a_gpu_without_its_kernels_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_has_numba_cuda", lambda: False)
    devices._module.cache_clear()
    with pytest.raises(CudaUnavailableError, match="pip install"):
        kernels_for("adam", torch.device("cuda"))
    assert kernels_for("adam", torch.device("cpu")).__name__ == "glassplat.kernels.adam.cpu"


@pytest.mark.skipif(importlib.util.find_spec("numba_cuda") is None, reason="numba-cuda is not installed")
@pytest.mark.parametrize(
    "name",
    [
        "adam",
        "bin_tiles",
        "blend_panes",
        "composite",
        "cube_lookup",
        "pane_hits",
        "photometric",
        "project",
        "shade_environment",
        "surface_channels",
    ],
)
def test_every_operation_has_the_same_functions_on_both_devices(name: str) -> None:
    cpu, cuda = (kernels_for(name, torch.device(kind)) for kind in ("cpu", "cuda"))
    own = {key for key, value in vars(cpu).items() if getattr(value, "__module__", "") == cpu.__name__}
    shared = {key for key in own if key == name or key in (f"{name}_gradient", f"{name}_gradients")}
    assert name in shared
    assert all(hasattr(cuda, key) for key in shared)
