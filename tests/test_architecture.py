"""The code follows the structure in docs/architecture.md: allowed imports between layers, and limits of size."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = "glassplat"
DIAGRAM = ROOT / "docs" / "architecture.md"
CHECKED_FOLDERS = (PACKAGE, "tests", "tools", "benchmarks")

MOST_FILE_LINES = 700
MOST_TEST_FILE_LINES = 600
MOST_FUNCTION_LINES = 60
MOST_KERNEL_LINES = 120
MOST_PARAMETERS = 8
SIGNATURES_OF_OTHERS = {"rasterization"}
"""Functions with the parameters of other programs' functions."""
LEAST_FILE_LINES = 60
"""A file with fewer needs two importers."""
MOST_FILES = 180
"""Number of files of the package; a new one replaces another, or the commit that raises this gives the reason."""
MOST_IMPORT_SHARE = 0.0625
"""Share of the package's lines; viser has 3 %, equinox 5.7 %."""
MEANINGLESS_NAMES = {"utils", "util", "helpers", "helper", "common", "misc"}


@dataclass(frozen=True)
class Limits:
    """Limits of the size of one file and its functions; `parameters` is None if their number is not limited."""

    file_lines: int
    function_lines: int
    parameters: int | None


def limits_of(path: Path) -> Limits:
    """The limits for a file, by its path relative to the repository."""
    if path.parts[0] == "tests":
        return Limits(MOST_TEST_FILE_LINES, MOST_FUNCTION_LINES, None)
    if path.parts[:2] == (PACKAGE, "kernels"):
        return Limits(MOST_FILE_LINES, MOST_KERNEL_LINES, None)
    return Limits(MOST_FILE_LINES, MOST_FUNCTION_LINES, MOST_PARAMETERS)


def rows_of(diagram: str) -> dict[str, int]:
    """Row of each layer in the first code block of the architecture page; row 0 is the top."""
    block = diagram.split("```")[1].strip("\n")
    rows: dict[str, int] = {}
    for row, line in enumerate(block.splitlines()):
        names = line.split("(")[0].replace("└──", " ")
        rows |= dict.fromkeys(names.split(), row)
    return rows


def module_of(path: Path) -> str:
    """Dotted name of the module in a file, by its path relative to the repository."""
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def layer_of(module: str) -> str | None:
    """The layer of the package that a module belongs to; None for the package itself and for foreign modules."""
    parts = module.split(".")
    if parts[0] != PACKAGE or len(parts) == 1 or parts[1].startswith("__"):
        return None
    return parts[1]


def imported_modules(tree: ast.Module, path: Path) -> Iterator[tuple[str, int]]:
    """Every module imported by a file, at any depth and under TYPE_CHECKING too, with the line."""
    package = path.with_suffix("").parts[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            names = [alias.name for alias in node.names] if base == PACKAGE else []
            yield from ((f"{base}.{name}", node.lineno) for name in names)
            yield base, node.lineno


def import_violations(tree: ast.Module, path: Path, rows: Mapping[str, int]) -> Iterator[str]:
    """Imports that do not point downwards in the diagram."""
    layer = layer_of(module_of(path))
    if layer is None:
        return
    if layer not in rows:
        yield f"{path}: `{layer}` is not in the diagram of docs/architecture.md; draw it there on its row"
        return
    for module, line in imported_modules(tree, path):
        target = layer_of(module)
        if target not in rows or target == layer or rows[target] > rows[layer]:
            continue
        yield (
            f"{path}:{line}: `{layer}` imports {module}, but imports point downwards only and `{target}` is on "
            f"row {rows[target]}, `{layer}` on row {rows[layer]}; move what is shared to a lower layer"
        )


def code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Number of lines of a function without decorators and docstring, which may be a manual page."""
    last = function.end_lineno or function.lineno
    lines = last - function.lineno + 1
    if ast.get_docstring(function, clean=False) is not None:
        docstring = function.body[0]
        lines -= (docstring.end_lineno or docstring.lineno) - docstring.lineno + 1
    return lines


def parameter_count(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Number of parameters, without `self` and `cls`."""
    arguments = function.args
    named = [*arguments.posonlyargs, *arguments.args]
    bound = bool(named) and named[0].arg in ("self", "cls")
    return (
        len(named) - bound + len(arguments.kwonlyargs) + sum(a is not None for a in (arguments.vararg, arguments.kwarg))
    )


def size_violations(tree: ast.Module, path: Path, source: str) -> Iterator[str]:
    """Files and functions that are too long, and functions with too many parameters."""
    limits = limits_of(path)
    if (lines := source.count("\n")) > limits.file_lines:
        yield f"{path}: {lines} lines where {limits.file_lines} are the most; split it by what it holds"
    for node in ast.walk(tree):
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        where = f"{path}:{node.lineno}: {node.name}()"
        if (lines := code_lines(node)) > limits.function_lines:
            yield f"{where} has {lines} lines of code where {limits.function_lines} are the most; name its parts"
        if limits.parameters is None or node.name in SIGNATURES_OF_OTHERS:
            continue
        if (count := parameter_count(node)) > limits.parameters:
            yield f"{where} takes {count} parameters where {limits.parameters} are the most; group them"


def name_violations(path: Path) -> Iterator[str]:
    """File and folder names that do not describe their contents."""
    for part in path.with_suffix("").parts:
        if part.lower() in MEANINGLESS_NAMES:
            yield f"{path}: `{part}` says nothing; name it after what it holds"


def violations(path: Path, source: str, rows: Mapping[str, int]) -> list[str]:
    """All violations of one file, given its path relative to the repository."""
    tree = ast.parse(source)
    return [*import_violations(tree, path, rows), *size_violations(tree, path, source), *name_violations(path)]


def source_files() -> list[Path]:
    """All Python files of the project, relative to the repository."""
    return sorted(file.relative_to(ROOT) for folder in CHECKED_FOLDERS for file in (ROOT / folder).rglob("*.py"))


@pytest.fixture(scope="module")
def rows() -> dict[str, int]:
    return rows_of(DIAGRAM.read_text())


def test_every_file_keeps_the_architecture(rows: dict[str, int]) -> None:
    found = [line for path in source_files() for line in violations(path, (ROOT / path).read_text(), rows)]
    assert not found, "\n" + "\n".join(found)


def test_docstrings_name_only_attributes_that_exist() -> None:
    stale = []
    for path in source_files():
        for node in ast.walk(ast.parse((ROOT / path).read_text())):
            if not isinstance(node, ast.ClassDef) or node.bases or not (docstring := ast.get_docstring(node)):
                continue
            described = re.findall(r"^    (\w+): ", docstring.partition("Attributes:\n")[2], re.MULTILINE)
            body = "\n".join(map(ast.unparse, node.body[1:]))
            stale += [f"{path}: {node.name}.{name}" for name in described if not re.search(rf"\b{name}\b", body)]
    assert not stale, stale


DESCRIBED = ("captures", "evaluate", "files", "methods", "panes", "render", "scene", "training")
"""Folders in which every constant number says what it is."""


def undescribed_numbers(source: str) -> list[str]:
    """Constants that are numbers and are followed by no string."""
    body = ast.parse(source).body
    return [
        ast.unparse(statement)
        for statement, following in zip(body, [*body[1:], None], strict=True)
        if isinstance(statement, ast.Assign) and re.fullmatch(r"[-+*/.,() \de]*", ast.unparse(statement.value))
        if not (isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant))
    ]


def test_constants_that_decide_results_are_described() -> None:
    assert undescribed_numbers('ONE = 1\nTWO, THREE = 2.0, 1 / 3\n"""Both."""') == ["ONE = 1"]
    sources = [(path, source) for path, source in package_sources().items() if path.parts[1] in DESCRIBED]
    assert len(sources) > 30
    assert not [f"{path}: {number}" for path, source in sources for number in undescribed_numbers(source)]


def test_the_diagram_names_only_what_exists(rows: dict[str, int]) -> None:
    package = ROOT / PACKAGE
    missing = [name for name in rows if not (package / name).is_dir() and not (package / f"{name}.py").is_file()]
    assert not missing, f"docs/architecture.md draws {missing}, which {package} does not hold"


def test_the_diagram_has_kernels_and_scene_side_by_side_at_the_bottom(rows: dict[str, int]) -> None:
    assert rows["kernels"] == rows["scene"] == max(rows.values())
    assert rows["cli"] == 0


class WithoutTyping(ast.NodeTransformer):
    """Removes imports that are used for annotations only."""

    def visit_If(self, node: ast.If) -> ast.AST | None:
        """None for `if TYPE_CHECKING:`."""
        return None if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING" else self.generic_visit(node)


def import_graph(sources: Mapping[Path, str]) -> dict[str, set[str]]:
    """The modules of the package that each of its modules imports at run time, at any depth."""
    known = {module_of(path) for path in sources}
    graph: dict[str, set[str]] = {}
    for path, source in sources.items():
        found: set[str] = set()
        for node in ast.walk(WithoutTyping().visit(ast.parse(source))):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= {name if name in known else f"{node.module}" for name in names}
        graph[module_of(path)] = (found & known) - {module_of(path), PACKAGE}
    return graph


def package_sources() -> dict[Path, str]:
    return {path: (ROOT / path).read_text() for path in source_files() if path.parts[0] == PACKAGE}


def lonely_files(sources: Mapping[Path, str]) -> list[str]:
    """Small files with a single importer, except the backends of kernels, which are found by name."""
    graph = import_graph(sources)
    importers = {module: sum(module in imported for imported in graph.values()) for module in graph}
    return [
        f"{path}: {source.count(chr(10))} lines for one importer; put them there"
        for path, source in sources.items()
        if source.count("\n") < LEAST_FILE_LINES
        and importers[module_of(path)] < 2
        and not path.name.startswith("__")
        and path.name not in ("cpu.py", "cuda.py", "reference.py")
    ]


def test_no_modules_import_each_other_in_a_circle() -> None:
    TopologicalSorter(import_graph(package_sources())).prepare()  # Raises CycleError, which names the cycle.


def test_no_small_file_has_a_single_importer() -> None:
    found = lonely_files(package_sources())
    assert not found, "\n" + "\n".join(found)


def import_share(sources: Mapping[Path, str]) -> float:
    """Share of lines that belong to import statements."""
    lines = imports = 0
    for source in sources.values():
        lines += source.count("\n")
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                imports += (node.end_lineno or node.lineno) - node.lineno + 1
    return imports / lines


def test_the_package_has_few_files_and_few_lines_that_import() -> None:
    sources = package_sources()
    assert len(sources) <= MOST_FILES
    assert import_share(sources) <= MOST_IMPORT_SHARE
    assert import_share({Path("a.py"): "import os\nfrom os import (\n    path,\n)\n\nprint()\n"}) == 4 / 6


def test_a_circle_of_late_imports_is_found() -> None:
    late = "def f():\n    from glassplat.b import g\n"
    with pytest.raises(CycleError):
        TopologicalSorter(
            import_graph({Path("glassplat/a.py"): late, Path("glassplat/b.py"): "from glassplat import a"})
        ).prepare()
    annotated = "if TYPE_CHECKING:\n    from glassplat.a import f\n"
    assert import_graph({Path("glassplat/a.py"): late, Path("glassplat/b.py"): annotated})["glassplat.b"] == set()


def test_a_small_file_for_one_other_is_found() -> None:
    sources = {Path("glassplat/a.py"): "from glassplat.b import g\n" * 60, Path("glassplat/b.py"): "def g(): ...\n"}
    (message,) = lonely_files(sources)
    assert "b.py: 1 lines for one importer" in message
    assert lonely_files({**sources, Path("glassplat/c.py"): "import glassplat.b\n" * 60}) == []


SMALL_ROWS = {"cli": 0, "training": 1, "render": 2, "files": 2, "kernels": 3, "scene": 3}


@pytest.mark.parametrize(
    ("path", "statement", "blamed"),
    [
        ("glassplat/render/splat.py", "from glassplat.training.loop import train", "training"),
        ("glassplat/render/splat.py", "import glassplat.cli", "cli"),
        ("glassplat/render/splat.py", "from glassplat.files.ply import read_ply", "files"),
        ("glassplat/kernels/project/operation.py", "from glassplat.scene.camera import Camera", "scene"),
        ("glassplat/kernels/project/operation.py", "from glassplat import scene", "scene"),
        ("glassplat/kernels/project/cpu.py", "from ...scene import camera", "scene"),
        ("glassplat/scene/camera.py", "def late():\n    import glassplat.render.splat", "render"),
    ],
)
def test_an_import_that_does_not_point_downwards_is_found(path: str, statement: str, blamed: str) -> None:
    (message,) = violations(Path(path), statement + "\n", SMALL_ROWS)
    assert path in message
    assert f"`{blamed}` is on row" in message


@pytest.mark.parametrize(
    ("path", "statement"),
    [
        ("glassplat/render/splat.py", "from glassplat.scene.camera import Camera"),
        ("glassplat/render/splat.py", "from glassplat.render.frame import Frame"),
        ("glassplat/render/splat.py", "from . import frame"),
        ("glassplat/cli/main.py", "from glassplat import __version__"),
        ("glassplat/__main__.py", "from glassplat.cli import main"),
        ("glassplat/scene/camera.py", "import torch"),
        ("tests/test_x.py", "from glassplat.cli import main"),
    ],
)
def test_an_import_that_points_downwards_is_allowed(path: str, statement: str) -> None:
    assert violations(Path(path), statement + "\n", SMALL_ROWS) == []


def test_a_folder_outside_the_diagram_is_found() -> None:
    (message,) = violations(Path("glassplat/extras/video.py"), "", SMALL_ROWS)
    assert "`extras` is not in the diagram" in message


def long_function(lines: int) -> str:
    return 'def work():\n    """Counts.\n\n    At length.\n    """\n' + "    x = 1\n" * (lines - 1)


def test_a_function_is_measured_without_its_docstring() -> None:
    assert violations(Path("tools/a.py"), long_function(MOST_FUNCTION_LINES), SMALL_ROWS) == []
    (message,) = violations(Path("tools/a.py"), long_function(MOST_FUNCTION_LINES + 1), SMALL_ROWS)
    assert "work() has 61 lines of code" in message


def test_kernels_may_be_longer_and_take_more() -> None:
    source = long_function(MOST_KERNEL_LINES) + "def many(a, b, c, d, e, f, g, h, i): ...\n"
    assert violations(Path("glassplat/kernels/x/cpu.py"), source, SMALL_ROWS) == []
    assert len(violations(Path("glassplat/render/x.py"), source, SMALL_ROWS)) == 2


def test_parameters_are_counted_without_self() -> None:
    body = "class A:\n    def f(self, a, b, c, d, *, e, f, g, {}): ...\n"
    assert violations(Path("glassplat/render/x.py"), body.format("h"), SMALL_ROWS) == []
    (message,) = violations(Path("glassplat/render/x.py"), body.format("h, **rest"), SMALL_ROWS)
    assert "f() takes 9 parameters" in message


def test_a_long_file_is_found() -> None:
    (message,) = violations(Path("glassplat/render/x.py"), "x = 1\n" * (MOST_FILE_LINES + 1), SMALL_ROWS)
    assert "701 lines where 700 are the most" in message


@pytest.mark.parametrize("path", ["glassplat/render/utils.py", "tests/helpers/x.py", "tools/Common.py"])
def test_meaningless_file_names_are_found(path: str) -> None:
    (message,) = violations(Path(path), "", SMALL_ROWS)
    assert re.search(r"`(utils|helpers|Common)` says nothing", message)
