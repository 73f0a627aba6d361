"""Contents of files are data: nothing in the package executes them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import glassplat

ROOT = Path(glassplat.__file__).parent
EXECUTING = {
    "eval", "exec", "compile", "os.system", "os.popen", "pickle.load", "pickle.loads", "marshal.load", "marshal.loads",
    "torch.load", "torch.jit.load",
}  # fmt: skip
"""Functions that execute their arguments, or that a file can make execute code."""


def executed(tree: ast.AST) -> Iterator[str]:
    """Calls of such functions, and options of calls with the same effect."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            if name in EXECUTING:
                yield name
            for option in node.keywords:
                if option.arg in ("allow_pickle", "shell") and ast.unparse(option.value) != "False":
                    yield f"{option.arg}={ast.unparse(option.value)}"


@pytest.mark.parametrize(
    "source", ["eval(text)", "torch.load(path)", "np.load(path, allow_pickle=True)", "run(command, shell=True)"]
)
def test_calls_that_execute_code_are_found(source: str) -> None:
    assert list(executed(ast.parse(source)))


def test_nothing_that_a_file_holds_is_executed() -> None:
    found = {path: list(executed(ast.parse(path.read_text(encoding="utf-8")))) for path in ROOT.rglob("*.py")}
    assert len(found) > 50
    assert {path: names for path, names in found.items() if names} == {}
