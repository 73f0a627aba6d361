"""Every CUDA kernel compiles for three generations of GPUs, without a GPU; prints what each of them takes."""

from __future__ import annotations

import re
from typing import Any

import pytest

pytest.importorskip("numba_cuda", reason="numba-cuda is not installed; `make setup` installs it")

from glassplat.kernels.backend.devices import SIMULATED
from tools.compile_kernels import CAPABILITIES, all_kernels, linked, loop_cells, ptx_of, read_report
from tools.machine_loops import Loop, Loops, disassembler, loops_of, read_loops

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
        found = linked(text, capability).resources
        print(f"{kernel.name} sm_{capability[0]}{capability[1]}: {found}")
        assert 0 < found.registers <= MOST_REGISTERS
        assert found.spilled == 0
        assert found.shared <= MOST_SHARED_BYTES


def test_every_operation_has_its_kernels() -> None:
    names = {kernel.name.rsplit("_", 1)[0] for kernel in KERNELS}
    both_ways = {"project", "composite", "blend_panes", "photometric", "cube_lookup"}
    traced = {f"trace_{step}_{kind}" for step in ("forward", "pull") for kind in ("discs", "ellipsoids")}
    both_ways |= {"shade_environment", "surface_channels", "project_discs", "composite_discs"}
    expected = {f"{name}_{way}" for name in both_ways for way in ("forward", "backward")} | {"adam", "pane_hits"}
    expected |= traced | {"count_tiles", "emit_tiles", "hilbert_places", "fit_leaves", "fit_level"}
    assert all(any(name.startswith(want) for name in names) for want in expected)


def test_the_linkers_report_is_read() -> None:
    report = "4 bytes stack frame, 8 bytes spill stores, 12 bytes spill loads\nUsed 40 registers, 1024 bytes smem"
    assert read_report(report) == (40, 20, 1024, 4)


WITHOUT_DISASSEMBLER = pytest.mark.skipif(disassembler() is None, reason="nvdisasm is not installed")
NAMED = {kernel.name: kernel for kernel in KERNELS}


def counted(name: str) -> Loops:
    """What the loops of a kernel cost on an H100."""
    (text,) = ptx_of(NAMED[name], [(9, 0)])
    found = loops_of(linked(text, (9, 0)).cubin)
    assert found is not None
    return found


@WITHOUT_DISASSEMBLER
@pytest.mark.filterwarnings("ignore::numba.core.errors.NumbaPerformanceWarning")
@pytest.mark.parametrize(
    ("name", "least", "most"),
    # The dearest turn of the forward pass is that of a glass splat, of the backward pass one with a deviation.
    [("composite_forward_4_float32", 20, 58), ("composite_backward_4_probed_float32", 16, 98)],
)
def test_a_splat_costs_a_pixel_no_more_instructions_than_it_did(name: str, least: int, most: int) -> None:
    turn = counted(name).dearest
    assert 0 < turn.least <= least
    assert turn.least < turn.most <= most


@WITHOUT_DISASSEMBLER
@pytest.mark.filterwarnings("ignore::numba.core.errors.NumbaPerformanceWarning")
def test_a_pair_is_emitted_without_float64() -> None:
    assert counted("emit_tiles_int16").float64 == 0
    # What is counted for each splat is, which shows that such instructions are seen.
    assert counted("count_tiles_float32").float64 > 0


PROGRAM = """
//--------------------- .text.kernel ---
.text.kernel:
        /*0000*/                   S2R R0, SR_TID.X ;
.L_x_1:
        /*0010*/                   IADD3 R1, R1, 0x1, RZ ;
        /*0020*/              @!P0 BRA `(.L_x_2) ;
        /*0030*/                   DADD R2, R2, R4 ;
        /*0040*/                   F2F.F64.F32 R4, R6 ;
        /*0050*/                   MUFU.EX2 R6, R6 ;
.L_x_2:
        /*0060*/                   ISETP.LT.AND P1, PT, R1, R9, PT ;
        /*0070*/               @P1 BRA `(.L_x_1) ;
        /*0080*/                   DMUL R2, R2, R4 ;
        /*0090*/                   EXIT ;
.L_x_3:
        /*00a0*/                   BRA `(.L_x_3);
"""


def test_the_turns_of_a_loop_are_read_from_a_disassembly() -> None:
    found = read_loops(PROGRAM)
    assert found == Loops(Loop(least=4, most=7), float64=2)
    assert loop_cells(found) == ("4 to 7", "2")
    assert loop_cells(Loops(Loop(0, 0), 0)) == ("", "")
    assert loop_cells(None) == ("?", "?")


MEETING = """
//--------------------- .text.kernel ---
.text.kernel:
.L_x_1:
        /*0000*/                   UMOV UR4, 0xffffffff ;
        /*0010*/                   BRA.DIV UR4, `(.L_x_3) ;
.L_x_2:
        /*0020*/                   BRA.CONV ~URZ, `(.L_x_4) ;
        /*0030*/                   MOV R4, 0xffffffff ;
        /*0040*/                   CALL.ABS.NOINC `(__cuda_sm70_warpsync) ;
.L_x_4:
        /*0050*/              @P1 BRA `(.L_x_1) ;
        /*0060*/                   EXIT ;
.L_x_3:
        /*0070*/                   WARPSYNC.COLLECTIVE R4, `(.L_x_5) ;
.L_x_5:
        /*0080*/                   BRA `(.L_x_2) ;
"""


def test_threads_that_wait_for_each_other_are_counted_as_together() -> None:
    assert read_loops(MEETING).dearest == Loop(least=4, most=4)


Tree = str | tuple[str, list[Any]]


def exponent_of(ptx: str) -> Tree:
    """How the first exponent is computed: the names of instructions and what they take, down to what is loaded."""
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
    """Whether both compute the same: what `pattern` loads, the other may have computed, the same wherever it stands."""
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
@pytest.mark.parametrize("other", ["composite_deviation_float32", "composite_backward_4_probed_float32"])
def test_every_pass_computes_the_same_coverage(other: str) -> None:
    first, second = (exponent_of(ptx_of(NAMED[name], [(8, 9)])[0]) for name in ("composite_forward_4_float32", other))
    assert agree(first, second, {}), (first, second)
    # Nothing is left to the linker, which could fuse a product and a sum.
    assert str(first).count("fma.rn.f32") == 2
    assert "add" not in str(first)


def test_computations_of_another_order_do_not_agree() -> None:
    product = ("mul.f32", [("mul.f32", ["%a", "%b"]), "%b"])
    assert agree(product, ("mul.f32", ["%2", ("mul.f32", ["%1", "%2"])]), {})
    assert not agree(product, ("mul.f32", [("mul.f32", ["%2", "%2"]), "%1"]), {})
    fused = ("fma.rn.f32", ["%a", "%b", ("mul.f32", ["%c", "%d"])])
    assert not agree(fused, ("fma.rn.f32", ["%3", "%4", ("mul.f32", ["%1", "%1"])]), {})
