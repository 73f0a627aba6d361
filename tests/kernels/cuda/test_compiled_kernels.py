"""Every CUDA kernel compiles without a GPU; prints the resources each of them uses.

Those of float32 compile for three generations of GPUs, those of float64, which only tests use, for one.
"""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba_cuda", reason="numba-cuda is not installed; `make setup` installs it")

from glassplat.kernels.backend.cpu_cache import KernelFiles, load_data
from glassplat.kernels.backend.devices import SIMULATED
from tools import compile_kernels
from tools.compile_kernels import CAPABILITIES, Resources, all_kernels, linked, ptx_of, read_report

if SIMULATED:
    pytest.skip("the simulator has no compiler", allow_module_level=True)

MOST_REGISTERS = 255
MOST_SHARED_BYTES = 48 * 1024
KERNELS = all_kernels()
DOUBLES = [kernel for kernel in all_kernels(np.float64) if kernel.name.endswith("float64")]
NAMED = {kernel.name: kernel for kernel in [*KERNELS, *DOUBLES]}
TOOL = hashlib.sha256(Path(compile_kernels.__file__).read_bytes()).hexdigest()


@cache
def compiled(
    name: str, capabilities: tuple[tuple[int, int], ...] = CAPABILITIES
) -> dict[tuple[int, int], tuple[str, Resources]]:
    """PTX and resources of a kernel for each generation.

    Compiling takes seconds, so they are stored like machine code until the kernel, a function that it uses, a compiler
    or the tool changes.
    """
    kernel = NAMED[name]
    folders, key = KernelFiles(kernel.function), f"{kernel._images.key(capabilities)} {TOOL}"
    files = folders.files(kernel.function)
    found = load_data(files, key)
    if found is None or found[0] != key:  # Another process may have written its own under the same name.
        texts = zip(capabilities, ptx_of(kernel, capabilities), strict=True)
        found = key, {capability: (text, linked(text, capability)) for capability, text in texts}
        folders.store(files[0], key, found)
    return found[1]


@pytest.mark.filterwarnings("ignore::numba.core.errors.NumbaPerformanceWarning")
@pytest.mark.parametrize("kernel", [*KERNELS, *DOUBLES], ids=lambda kernel: kernel.name)
def test_the_kernel_compiles_and_fits(kernel) -> None:
    for capability, (text, found) in compiled(
        kernel.name, CAPABILITIES[1:2] if kernel in DOUBLES else CAPABILITIES
    ).items():
        assert f".target sm_{capability[0]}{capability[1]}" in text
        print(f"{kernel.name} sm_{capability[0]}{capability[1]}: {found}")
        assert 0 < found.registers <= MOST_REGISTERS
        assert found.spilled == 0
        assert found.shared <= MOST_SHARED_BYTES


def test_every_operation_has_its_kernels() -> None:
    names = {kernel.name.rsplit("_", 1)[0] for kernel in KERNELS}
    both_ways = {"project", "composite", "blend_panes", "photometric", "cube_lookup"}
    traced = {f"trace_{step}_{kind}" for step in ("forward", "gradients") for kind in ("discs", "ellipsoids")}
    both_ways |= {"shade_environment", "surface_channels", "project_discs", "composite_discs"}
    expected = {f"{name}_{way}" for name in both_ways for way in ("forward", "backward")} | {"adam", "pane_hits"}
    expected |= traced | {"count_tiles", "order_counts", "list_spans", "emit_tiles", "list_pairs"}
    expected |= {"hilbert_positions", "fit_leaves", "fit_level"}
    assert all(any(name.startswith(want) for name in names) for want in expected)


def test_the_linkers_report_is_read() -> None:
    report = "4 bytes stack frame, 8 bytes spill stores, 12 bytes spill loads\nUsed 40 registers, 1024 bytes smem"
    assert read_report(report) == (40, 20, 1024, 4)


@pytest.mark.filterwarnings("ignore::numba.core.errors.NumbaPerformanceWarning")
def test_a_pair_is_emitted_without_float64() -> None:
    emitted, counted = (compiled(name)[9, 0][0] for name in ("emit_tiles_int16", "count_tiles_float32"))
    assert ".f64" not in emitted
    assert ".f64" in counted, "what is counted for each splat is, which shows that it would be seen"


Tree = str | tuple[str, list[Any]]


def exponent_of(ptx: str) -> Tree:
    """Expression tree of the first exponent: names of instructions and their operands, down to loaded values."""
    body = ptx[ptx.index(".entry") :]
    made = {
        register: (name, arguments.split(", "))
        for name, register, arguments in re.findall(r"^\s*([a-z][\w.]*)\s+(%\w+), ([^;]+);", body, re.MULTILINE)
        if name.startswith(("fma", "mul", "add", "sub"))
    }

    def tree(operand: str) -> Tree:
        if operand not in made:
            return operand
        name, operands = made[operand]
        return name, [tree(one) for one in operands]

    (exponent, *_) = re.findall(r"ex2\.approx\.ftz\.f32 %\w+, (%\w+)", body)
    return tree(exponent)


def agree(pattern: Tree, other: Tree, known: dict[str, Tree]) -> bool:
    """True if both compute the same value; a leaf of `pattern` may stand for any one subexpression of `other`."""
    if isinstance(pattern, str):
        is_another = any(value == other for name, value in known.items() if name != pattern)
        return not is_another and known.setdefault(pattern, other) == other
    if isinstance(other, str) or pattern[0] != other[0]:
        return False
    swapped = [other[1][1], other[1][0], *other[1][2:]]
    for operands in (other[1], swapped if pattern[0].startswith(("mul", "fma")) else other[1]):
        tried = dict(known)
        if all(agree(one, two, tried) for one, two in zip(pattern[1], operands, strict=True)):
            known.update(tried)
            return True
    return False


@pytest.mark.filterwarnings("ignore::numba.core.errors.NumbaPerformanceWarning")
@pytest.mark.parametrize("other", ["composite_deviation_float32", "composite_backward_4_absgrad_float32"])
def test_every_pass_computes_the_same_coverage(other: str) -> None:
    first, second = (exponent_of(compiled(name)[9, 0][0]) for name in ("composite_forward_4_float32", other))
    assert agree(first, second, {}), (first, second)
    # No contraction is left to the linker, which could fuse a product and a sum.
    assert str(first).count("fma.rn.f32") == 2
    assert "add" not in str(first)


def test_computations_of_another_order_do_not_agree() -> None:
    product = ("mul.f32", [("mul.f32", ["%a", "%b"]), "%b"])
    assert agree(product, ("mul.f32", ["%2", ("mul.f32", ["%1", "%2"])]), {})
    assert not agree(product, ("mul.f32", [("mul.f32", ["%2", "%2"]), "%1"]), {})
    fused = ("fma.rn.f32", ["%a", "%b", ("mul.f32", ["%c", "%d"])])
    assert not agree(fused, ("fma.rn.f32", ["%3", "%4", ("mul.f32", ["%1", "%1"])]), {})
