"""Compiled kernels are loaded from the disk: other processes compile nothing, and a changed formula is recompiled."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest

from glassplat.kernels.backend.cpu_cache import fingerprint
from tests.kernels.small_kernel import FORMULA, SMALL_KERNEL, printed_by

OPERATIONS = """
import gc

import torch

from glassplat.kernels.adam import Update, adam
from glassplat.kernels.tiles import bin_tiles
from glassplat.kernels.panes import blend_panes
from glassplat.kernels.composite import composite
from glassplat.kernels.backend.cpu import Kernel
from glassplat.kernels.environment import cube_lookup
from glassplat.kernels.panes import gradient_conflict
from glassplat.kernels.panes import pane_hits
from glassplat.kernels.records import Panes
from glassplat.kernels.project import project
from glassplat.kernels.environment import shade_environment
from glassplat.kernels.records import CameraBatch, Deviation, RawGaussians, Splats
from glassplat.kernels.photometric import photometric
from glassplat.kernels.environment import surface_channels

means = torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0]])
raw = RawGaussians(means, torch.randn(2, 4), torch.full((2, 3), -2.0), torch.zeros(2), torch.zeros(2, 1, 3))
raw = RawGaussians(*(tensor.requires_grad_() for tensor in raw))
cameras = CameraBatch(torch.eye(4)[None], torch.tensor([[20.0, 20.0, 10.0, 8.0]]), 20, 16)
projected = project(raw, cameras, sh_degree=0, near=0.01)
splats = Splats(projected.means2d, projected.conics, projected.opacities, projected.depths, projected.radii)
bins = bin_tiles(splats, 20, 16)
result = composite(splats, projected.colors, bins, deviation=Deviation(0, torch.ones(1, 16, 20)))
intrinsics = cameras.intrinsics[0]
normal = torch.tensor([[0.0, 0.0, 1.0]])
panes = Panes(2 * normal, normal, torch.eye(3)[None, :2].contiguous(), torch.ones(1, 2))
pane = pane_hits(panes, intrinsics, 20, 16).pane
reflections = torch.ones(1, 16, 20, 4)
blended = blend_panes(result.image[0], result.alpha[0], reflections, pane, normal, torch.ones(1), intrinsics)
loss = photometric(blended.rgb, torch.zeros(16, 20, 3, dtype=torch.uint8)).ssim + result.deviation.sum()
loss = loss + gradient_conflict(result.image[0], blended.reflection, result.alpha[0])
texels = torch.zeros(6, 2, 2, 3, requires_grad=True)
fixed = raw.log_scales.detach(), means.detach(), torch.zeros(2), torch.zeros(3)
surface = surface_channels(projected.colors[0], torch.ones(2, 2), raw.quats, *fixed)
directions = surface[0, 3:6].expand(16, 20, 3)
surfaces = torch.cat([blended.rgb, directions, result.alpha[0][..., None]], dim=-1)
shaded = shade_environment(surfaces, result.alpha[0], texels, intrinsics, torch.eye(3))
loss = loss + shaded.rgb.sum() + cube_lookup(texels, directions).sum()
loss.backward()
adam([Update(means, raw.means.grad, torch.zeros(2, 3), torch.zeros(2, 3), 1e-3, 1)])

used = [k for k in gc.get_objects() if type(k) is Kernel and k.dispatcher.signatures]
missed = [k.name for k in used if k.compilations]
print(len(used), "kernels used, compiled:", *missed)
"""


def test_a_kernel_is_announced_then_cached_and_compiled_again_when_its_formula_changes(tmp_path: Path) -> None:
    script, cache = tmp_path / "small_kernel.py", str(tmp_path / "cache")
    script.write_text(SMALL_KERNEL)
    (tmp_path / "formula.py").write_text(FORMULA)
    *announced, result = printed_by(script, NUMBA_CACHE_DIR=cache)
    assert len(announced) == 2
    assert announced[0].startswith("compiling scale_float32 for this machine")
    assert announced[1].startswith("compiled scale_float32 in")
    assert result == "[4.0, 4.0] compiled 1"

    assert printed_by(script, NUMBA_CACHE_DIR=cache) == ["[4.0, 4.0] compiled 0"]

    (tmp_path / "formula.py").write_text(FORMULA.replace("OFFSET = 0", "OFFSET = 2"))
    assert printed_by(script, NUMBA_CACHE_DIR=cache)[-1] == "[10.0, 10.0] compiled 1"


def test_another_process_compiles_no_operation(tmp_path: Path) -> None:
    # This process imports in another order than the script, which breaks Numba's own cache.
    exec(OPERATIONS, {})
    script = tmp_path / "operations.py"
    script.write_text(OPERATIONS)
    (result,) = printed_by(script)
    used, _, compiled = result.partition(" kernels used, compiled:")
    assert int(used) >= 8
    assert compiled == ""


GRADIENT = """
import torch

from glassplat.kernels.photometric import photometric

generator = torch.Generator().manual_seed(1)
image = torch.rand(90, 120, 3, generator=generator).requires_grad_()
target = torch.randint(256, (90, 120, 3), dtype=torch.uint8, generator=generator)
loss = photometric(image, target)
(loss.l1 + loss.ssim).backward()
print(image.grad.numpy().tobytes().hex())
"""


def test_the_process_that_compiles_runs_the_same_kernels_as_the_next_one(tmp_path: Path) -> None:
    # For this loss, the body of a parallel loop differed in its last bits from the same body within its kernel.
    script = tmp_path / "gradient.py"
    script.write_text(GRADIENT)
    # Only there, and not next to the sources, where compiled kernels may already be stored.
    fresh = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
    first, second = (printed_by(script, **fresh)[-1] for _ in range(2))
    assert first == second


def test_a_disk_error_disables_only_the_cache(tmp_path: Path) -> None:
    script = tmp_path / "small_kernel.py"
    refuse = """
from numba.core.caching import IndexDataCacheFile

def refuse(*_):
    raise OSError("no space left")

IndexDataCacheFile.save = refuse
"""
    script.write_text(refuse + SMALL_KERNEL)
    (tmp_path / "formula.py").write_text(FORMULA)
    lines = printed_by(script, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert [line for line in lines if "cannot cache" in line] == [
        "cannot cache compiled kernels: no space left; set NUMBA_CACHE_DIR to a folder that is writable and permanent"
    ]
    assert lines[-1] == "[4.0, 4.0] compiled 1"


KERNEL_SOURCE = """
from math import exp
import numpy as np

LIMIT = 3
OFFSETS = (1, 2)

def shared(x):
    return x + OFFSETS[0]

def factory(factor):
    def inner(x):
        return factor * shared(x)

    def compiled(values, start=0):
        for i in range(start, LIMIT):
            values[i] = np.sqrt(inner(values[i])) + exp(0.5)

    return compiled

made = factory(np.float32(2))
"""


def made_from(source: str) -> Callable[..., Any]:
    """The function that a source defines."""
    names: dict[str, Any] = {"__name__": "made"}
    exec(source, names)
    return names["made"]


def test_equal_sources_have_equal_fingerprints() -> None:
    padded = "".join(["\n\n", KERNEL_SOURCE])
    assert fingerprint(made_from(KERNEL_SOURCE), "fast") == fingerprint(made_from(padded), "fast")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("LIMIT = 3", "LIMIT = 4"),
        ("OFFSETS = (1, 2)", "OFFSETS = (1, 3)"),
        ("x + OFFSETS[0]", "x - OFFSETS[0]"),
        ("OFFSETS[0]", "OFFSETS[-1]"),
        ("factor * shared(x)", "shared(x) * factor"),
        ("np.float32(2)", "np.float64(2)"),
        ("np.sqrt", "np.cbrt"),
        ("import exp", "import log as exp"),
        ("start=0", "start=1"),
    ],
)
def test_every_input_of_a_kernel_changes_its_fingerprint(old: str, new: str) -> None:
    assert old in KERNEL_SOURCE
    changed = KERNEL_SOURCE.replace(old, new)
    assert fingerprint(made_from(KERNEL_SOURCE), "fast") != fingerprint(made_from(changed), "fast")


@pytest.mark.parametrize(
    ("imported", "read"),
    [
        ("from glassplat.kernels.maths import disc", "disc.MOST_DEVIATIONS"),
        ("import glassplat.kernels.maths.disc", "glassplat.kernels.maths.disc.MOST_DEVIATIONS"),
        ("from glassplat.kernels.maths import disc", "(lambda: disc.MOST_DEVIATIONS)()"),
    ],
    ids=["module", "package", "nested function"],
)
def test_a_constant_read_through_a_module_changes_the_fingerprint(
    monkeypatch: pytest.MonkeyPatch, imported: str, read: str
) -> None:
    source = f"{imported}\n\ndef made(x):\n    return x + {read}\n"
    before = fingerprint(made_from(source), "fast")
    monkeypatch.setattr("glassplat.kernels.maths.disc.MOST_DEVIATIONS", 4.0)
    assert fingerprint(made_from(source), "fast") != before


CLOSURE_SOURCE = """
def factory():
    from glassplat.kernels.maths import disc

    def made(x):
        return x + disc.MOST_DEVIATIONS

    return made

made = factory()
"""


def test_a_constant_of_a_module_in_the_closure_changes_the_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    before = fingerprint(made_from(CLOSURE_SOURCE), "fast")
    monkeypatch.setattr("glassplat.kernels.maths.disc.MOST_DEVIATIONS", 4.0)
    assert fingerprint(made_from(CLOSURE_SOURCE), "fast") != before


ALIAS_SOURCE = """
def halved(x):
    return x / 2

def squared(x):
    return x * x

which = halved

def made(x):
    return which(squared(halved(x)))
"""


def test_the_choice_between_functions_that_are_used_anyway_changes_the_fingerprint() -> None:
    changed = ALIAS_SOURCE.replace("which = halved", "which = squared")
    assert fingerprint(made_from(ALIAS_SOURCE), "fast") != fingerprint(made_from(changed), "fast")


VECTOR_SOURCE = """
import numpy as np
from glassplat.kernels.backend.cpu_vector import constant, store, vector_kind

def factory(real, lanes):
    load, offsets = vector_kind(lanes).load, constant(real, (1.0,) * lanes)

    def compiled(values):
        store(values, 0, load(values, 0) + offsets())

    return compiled

made = factory(np.float32, 8)
"""


@pytest.mark.parametrize(("old", "new"), [("np.float32", "np.float64"), ("32, 8", "32, 16"), ("(1.0,)", "(2.0,)")])
def test_vectors_change_the_fingerprint(old: str, new: str) -> None:
    assert old in VECTOR_SOURCE
    same, changed = made_from(VECTOR_SOURCE), made_from(VECTOR_SOURCE.replace(old, new))
    assert fingerprint(made_from(VECTOR_SOURCE), "fast") == fingerprint(same, "fast")
    assert fingerprint(same, "fast") != fingerprint(changed, "fast")


def test_the_compiler_options_change_the_fingerprint() -> None:
    made = made_from(KERNEL_SOURCE)
    assert fingerprint(made, "fast") != fingerprint(made, "exact")


@pytest.mark.parametrize("value", [{"a": 1}, [1.0], numba.njit(lambda x: x)], ids=["dict", "list", "compiled kernel"])
def test_a_mutable_kernel_constant_is_refused(value: object) -> None:
    def compiled() -> object:
        return value

    with pytest.raises(TypeError, match="whose changes the cache would not notice; expected numbers"):
        fingerprint(compiled, "fast")
