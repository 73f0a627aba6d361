"""Every CUDA kernel compiles for three generations of GPUs, without a GPU; prints what each of them takes."""

from __future__ import annotations

import pytest

pytest.importorskip("numba_cuda", reason="numba-cuda is not installed; `make setup` installs it")

from glassplat.kernels.devices import SIMULATED
from tools.compile_kernels import CAPABILITIES, all_kernels, ptx_of, read_report, resources_of

if SIMULATED:
    pytest.skip("the simulator has no compiler", allow_module_level=True)

MOST_REGISTERS = 255
MOST_SHARED_BYTES = 48 * 1024
KERNELS = all_kernels()


@pytest.mark.filterwarnings("ignore::numba.core.errors.NumbaPerformanceWarning")
@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.name)
def test_the_kernel_compiles_and_fits(kernel) -> None:
    texts = ptx_of(kernel)
    for text, capability in zip(texts, CAPABILITIES, strict=True):
        assert f".target sm_{capability[0]}{capability[1]}" in text
        found = resources_of(text, capability)
        print(f"{kernel.name} sm_{capability[0]}{capability[1]}: {found}")
        assert 0 < found.registers <= MOST_REGISTERS
        assert found.spilled == 0
        assert found.shared <= MOST_SHARED_BYTES


def test_every_operation_has_its_kernels() -> None:
    names = {kernel.name.rsplit("_", 1)[0] for kernel in KERNELS}
    both_ways = {"project", "composite", "blend_panes", "photometric", "cube_lookup"}
    both_ways |= {"shade_environment", "surface_channels"}
    expected = {f"{name}_{way}" for name in both_ways for way in ("forward", "backward")} | {"adam", "pane_hits"}
    assert all(any(name.startswith(want) for name in names) for want in expected | {"count_tiles", "emit_tiles"})


def test_the_linkers_report_is_read() -> None:
    report = "4 bytes stack frame, 8 bytes spill stores, 12 bytes spill loads\nUsed 40 registers, 1024 bytes smem"
    assert read_report(report) == (40, 20, 1024)
