"""`import glassplat`: its names, and that it imports nothing heavy."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import glassplat


def test_importing_the_package_imports_none_of_the_libraries() -> None:
    script = (
        "import sys, glassplat; print([n for n in ('torch', 'numpy', 'numba', 'tyro', 'rich') if n in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_names_are_listed_consistently_in_all_three_places() -> None:
    homed = {name: f"glassplat.{module}" for module, names in glassplat.NAMES_BY_MODULE.items() for name in names}
    tree = ast.parse(Path(glassplat.__file__).read_text())
    typed = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("glassplat.")
        for alias in node.names
    }
    assert homed == typed
    assert sorted(homed) == sorted(glassplat.__all__) == sorted(set(dir(glassplat)) - {"__version__"})


def test_every_name_is_there_and_documented() -> None:
    for name in glassplat.__all__:
        found = getattr(glassplat, name)
        assert len(inspect.getdoc(found) or "") > 30, name
        assert found.__name__ == name
        members = vars(found).items() if inspect.isclass(found) else ()
        bare = [n for n, one in members if inspect.isfunction(one) and n[0] != "_" and not inspect.getdoc(one)]
        assert bare == [], name


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Trainer'; it has load, .*InputError"):
        glassplat.Trainer  # noqa: B018
