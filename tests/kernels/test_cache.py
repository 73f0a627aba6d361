"""Compiled kernels come from the disk: a second process compiles nothing, and a changed formula compiles again.

The cache of a kernel knows the file of the kernel, its bytecode and what it closes over; functions made by a factory
count with their code. It does not know globals imported from other files: those would go stale unnoticed.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import glassplat.kernels

KERNELS = Path(glassplat.kernels.__file__).parent
SOURCES = sorted([*KERNELS.glob("maths*.py"), *(KERNELS / "cpu").glob("*.py")])
COMPILED = ("inlined", "kernel")

FORMULA = """
from glassplat.kernels.cpu.jit import inlined


def scaling(real):
    factor = real(2)

    @inlined
    def scaled(x):
        return factor * x

    return scaled
"""

SMALL_KERNEL = """
import logging
import sys

import numpy as np

from glassplat.kernels.cpu.jit import kernel

from formula import scaling

logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)


def scale_in_place(real):
    scaled = scaling(real)

    @kernel("scale", real, parallel=False)
    def scale(values):
        for i in range(values.size):
            values[i] = scaled(values[i])

    return scale


if __name__ == "__main__":
    values = np.ones(2, np.float32)
    scale = scale_in_place(np.float32)
    scale(values)
    scale(values)
    print(values.tolist(), "misses", sum(scale.dispatcher.stats.cache_misses.values()))
"""

OPERATIONS = """
import gc

import torch

from glassplat.kernels.adam import adam
from glassplat.kernels.bin_tiles import bin_tiles
from glassplat.kernels.composite import composite
from glassplat.kernels.cpu.jit import Kernel
from glassplat.kernels.depth_deviation import depth_deviation
from glassplat.kernels.project import project
from glassplat.kernels.splats import CameraBatch, RawGaussians, Splats
from glassplat.kernels.ssim import ssim

means = torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0]])
raw = RawGaussians(means, torch.randn(2, 4), torch.full((2, 3), -2.0), torch.zeros(2), torch.zeros(2, 1, 3))
raw = RawGaussians(*(tensor.requires_grad_() for tensor in raw))
cameras = CameraBatch(torch.eye(4)[None], torch.tensor([[20.0, 20.0, 10.0, 8.0]]), 20, 16)
projected = project(raw, cameras, sh_degree=0, near=0.01)
splats = Splats(projected.means2d, projected.conics, projected.opacities, projected.depths, projected.radii)
bins = bin_tiles(splats, 20, 16)
image = composite(splats, projected.colors, bins).image
loss = ssim(image[0], torch.zeros(16, 20, 3)) + depth_deviation(splats, torch.ones(1, 16, 20), bins).sum()
loss.backward()
adam(means, raw.means.grad, torch.zeros(2, 3), torch.zeros(2, 3), lr=1e-3, step=1)

used = [k for k in gc.get_objects() if type(k) is Kernel and k.dispatcher.signatures]
missed = [k.name for k in used if sum(k.dispatcher.stats.cache_misses.values())]
print(len(used), "kernels used, compiled:", *missed)
"""


def printed_by(script: Path, **environment: str) -> list[str]:
    """Lines that a Python script prints in a process of its own."""
    done = subprocess.run(
        [sys.executable, str(script)], env=os.environ | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_kernel_is_announced_then_cached_and_compiled_again_when_its_formula_changes(tmp_path: Path) -> None:
    script, cache = tmp_path / "small_kernel.py", str(tmp_path / "cache")
    script.write_text(SMALL_KERNEL)
    (tmp_path / "formula.py").write_text(FORMULA)
    *announced, result = printed_by(script, NUMBA_CACHE_DIR=cache)
    assert len(announced) == 2
    assert announced[0].startswith("compiling scale_float32 for this machine")
    assert announced[1].startswith("compiled scale_float32 in")
    assert result == "[4.0, 4.0] misses 1"

    assert printed_by(script, NUMBA_CACHE_DIR=cache) == ["[4.0, 4.0] misses 0"]

    (tmp_path / "formula.py").write_text(FORMULA.replace("factor * x", "factor * x + factor"))
    assert printed_by(script, NUMBA_CACHE_DIR=cache)[-1] == "[10.0, 10.0] misses 1"


def test_a_second_process_compiles_no_operation(tmp_path: Path) -> None:
    script = tmp_path / "operations.py"
    script.write_text(OPERATIONS)
    printed_by(script)
    (result,) = printed_by(script)
    used, _, compiled = result.partition(" kernels used, compiled:")
    assert int(used) >= 8
    assert compiled == ""


def is_compiled(function: ast.FunctionDef) -> bool:
    """Whether a decorator hands the function to the kernel compiler."""
    names = [d.func if isinstance(d, ast.Call) else d for d in function.decorator_list]
    return any(isinstance(name, ast.Name) and name.id in COMPILED for name in names)


def names_from_other_files(tree: ast.Module) -> set[str]:
    """What a file imports from other files of the package."""
    imports = [
        node for node in tree.body if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("glassplat")
    ]
    return {alias.asname or alias.name for node in imports for alias in node.names}


def stale_risks(source: str) -> Iterator[str]:
    """Ways in which a compiled function may outlive a change of the formula it was made from."""
    tree = ast.parse(source)
    foreign = names_from_other_files(tree)
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef) or not is_compiled(node):
            continue
        if node in tree.body:
            yield f"line {node.lineno}: {node.name} is compiled at module level; make it in a factory"
        body = [inner for statement in node.body for inner in ast.walk(statement)]
        read = {n.id for n in body if isinstance(n, ast.Name)} & foreign
        for name in sorted(read):
            yield f"line {node.lineno}: {node.name} reads the imported global {name}; bind it in the factory"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_no_kernel_can_go_stale(path: Path) -> None:
    found = list(stale_risks(path.read_text()))
    assert not found, "\n".join([f"{path}:", *found])


def test_stale_risks_are_found() -> None:
    source = """
from glassplat.kernels.maths import LIMIT, scaling
from glassplat.kernels.cpu.jit import inlined, kernel

@inlined
def loose(x):
    return x

def factory(real):
    limit = real(LIMIT)
    scaled = scaling(real)

    @kernel("clip", real)
    def clip(values):
        values[0] = scaled(limit) + LIMIT
"""
    assert list(stale_risks(source)) == [
        "line 6: loose is compiled at module level; make it in a factory",
        "line 14: clip reads the imported global LIMIT; bind it in the factory",
    ]
