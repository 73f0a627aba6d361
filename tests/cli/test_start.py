"""The first half second of a command: modules imported for each request, and the help of each command."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest

import glassplat
from glassplat.cli.main import COMMANDS, main
from glassplat.cli.train import SCENE
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.recipe import recipe_to_json

SLOW = ["torch", "numba", "scipy", "numpy", "PIL", "pycolmap", "OpenEXR", "safetensors"]
LINES = """
import contextlib, io, json, sys

lines, watched = json.loads(sys.argv[1])
found = []
for words in lines:
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(io.StringIO()) as complained:
        from glassplat.cli.main import main
        try:
            code = main(words)
        except SystemExit as stop:
            code = stop.code
    slow = [name for name in watched if name in sys.modules]
    commands = [name for name in sys.modules if name.startswith("glassplat.cli.")]
    found.append((code, slow, commands, said.getvalue(), complained.getvalue()))
print(json.dumps(found))
"""
"""Runs command lines one after the other. Modules imported by one of them count for all that follow as well, so that a
line that passes after others passes alone."""


class Found(NamedTuple):
    """Exit code of a command line, modules imported by it and its predecessors, and its output."""

    code: int
    slow: list[str]
    commands: set[str]
    out: str
    err: str


def found_of(
    lines: Sequence[Sequence[str]], watched: Sequence[str], folder: Path | None = None, before: str = ""
) -> list[Found]:
    """Runs command lines in a separate process after a script, and records which watched modules are imported."""
    command = [sys.executable, "-c", before + LINES, json.dumps((lines, watched))]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    assert (done.returncode, done.stderr) == (0, "")
    return [Found(code, slow, set(commands), *said) for code, slow, commands, *said in json.loads(done.stdout)]


def test_the_list_of_commands_needs_none_of_the_libraries() -> None:
    right = [["--help"], ["-h"], ["--version"]]
    wrong = [[], ["trian"], ["--no-such-option"], ["--", "train"], ["Train"], [""]]
    for arguments, found in zip(right + wrong, found_of(right + wrong, SLOW), strict=True):
        assert found.code == (0 if arguments in right else 2), arguments
        assert found.slow == [], arguments
        assert not {f"glassplat.cli.{listed.module}" for listed in COMMANDS.values()} & found.commands
        assert "Traceback" not in found.err
        assert all(name in found.out + found.err for name in COMMANDS) or arguments == ["--version"]


def test_version_prints_what_a_bug_report_needs() -> None:
    done = subprocess.run([sys.executable, "-m", "glassplat", "--version"], capture_output=True, text=True, check=True)
    for name, version in (("glassplat", glassplat.__version__), ("PyTorch", metadata.version("torch"))):
        assert f"{name} {version}, " in done.stdout
    assert f"Python {platform.python_version()}, " in done.stdout
    assert done.stdout.startswith(f"glassplat {glassplat.__version__}, Python ")
    assert "NVIDIA driver" in done.stdout or "CUDA" in done.stdout


LATE = [
    "torch", "numba", "scipy.spatial", "scipy.ndimage", "scipy.interpolate", "scipy.optimize", "viser", "cv2",
    "OpenEXR", "pycolmap",
]  # fmt: skip


@pytest.fixture(scope="module")
def explained() -> dict[str, Found]:
    """The help of each command; commands that may import more than the others come last."""
    names = sorted(COMMANDS, key=lambda name: (name in ("prepare", "annotate"), name != "train", name))
    watched = [*LATE, "glassplat.evaluate.evaluate", "zstandard"]
    return dict(zip(names, found_of([[name, "--help"] for name in names], watched), strict=True))


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_command_explains_itself_and_imports_optional_modules_only_on_demand(
    name: str, explained: dict[str, Found]
) -> None:
    assert explained[name].code == 0
    assert f"usage: glassplat {name}" in explained[name].out
    assert " ".join(COMMANDS[name].summary.split()) in " ".join(explained[name].out.split())
    allowed = {"glassplat.evaluate.evaluate", "zstandard"} if name != "train" else set()
    allowed |= {"pycolmap"} if name in ("prepare", "annotate") else set()
    assert not set(explained[name].slow) - allowed


REFUSED = {
    "prepare none --output new": "no folder or video none",
    "annotate none": "no folder none; expected the folder of a capture, as `glassplat prepare` makes it",
    "train splat --data none --output new": "no folder none",
    "train splat --data splats.ply --output new": "a file; expected the folder of a capture. `glassplat.load` reads",
    "train splat --data begun --output new": "This is a run, which `glassplat.load` reads; expected a capture",
    "train splat --data=capture --data=none --output new": "no folder none",
    "train planar --data unmarked --output new": "unmarked has no masks of panes, and planar needs to know the panes",
    "train planar --data capture --output trained": "trained already holds a run",
    "train planar --data capture --output new --resume": "nothing was saved yet in new",
    "train planar --data capture --output splats.ply": "splats.ply is a file",
    "eval capture": "capture is not a run directory",
    "render capture --output new": "capture is not a run directory",
    "render begun --output capture": "capture is not empty",
    "dereflect none --output new": "none does not exist",
    "dereflect begun --output capture": "capture is not empty",
    "view none": "none does not exist; expected a run, a folder of an export, or a splat file (.ply, ",
    "view capture": "capture holds no scene; expected a run, a folder of an export, or a splat file (.ply, ",
    "view capture --port 0": "`glassplat info capture` says what it is",
    "view splats.txt": "splats.txt is not a splat file by its name; expected a run, a folder of an export, ",
    "train": "a method is missing; expected one of splat, planar, deferred, traced: see glassplat train --help",
    "train --data capture --output new": "a method is missing; expected one of splat, planar, deferred, traced",
    "view splats.ply --host none.invalid": "none.invalid is not an address of this machine",
    "view splats.ply --host 192.0.2.1": "192.0.2.1 is not an address of this machine",
    "view none.ply": "none.ply does not exist; expected a run, ",
    "view splats.ply --port 65536": "port is 65536",
    "view splats.ply --output splats.ply": "splats.ply is a file",
    "video none --output film.webp": "none does not exist",
    "video begun --output film.avi": "film.avi is not a video name",
    "video begun --output film.gif --path keyframes --keyframes none.json": "none.json does not exist; expected cam",
    "export none --output new": "none does not exist",
    "export begun --output capture": "capture is not empty",
    "export none.ply --output new": "none.ply does not exist",
    "view splats.ply --planes none.json": "none.json does not exist; expected panes as in the planes.json",
    "clean begun --output x.txt": "x.txt: expected a name that ends in .ply, ",
    "info none": "none does not exist",
    "info splats.txt": "splats.txt is not a known kind of file; expected a capture, photographs, ",
    "info photographs/0000.jpg": "photographs/0000.jpg is one photograph; expected a capture, photographs, ",
    "info capture/../photographs/0001.jpg": "`glassplat info capture/../photographs` says what its folder is",
    "clean splats.ply --output folder.ply": "folder.ply already exists; nothing was written",
    "demo --output splats.ply": "splats.ply is a file",
    "demo --output demo": "demo/splat holds recipe.json, which is not from a run of this version",
}
"""Command lines and their error messages without PyTorch."""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a capture, two runs and files, as far as they are checked before PyTorch is imported."""
    root = tmp_path_factory.mktemp("places")
    for name in ("capture/images", "begun", "trained", "photographs", "folder.ply", "demo/splat"):
        (root / name).mkdir(parents=True)
    (root / "demo/splat/recipe.json").write_bytes(b"")
    for name in ("begun/recipe.json", "trained/recipe.json", "trained/checkpoint.safetensors", "splats.ply"):
        (root / name).write_bytes(b"")
    (root / "splats.txt").write_bytes(b"")
    shutil.copytree(SCENE, root / "unmarked", ignore=shutil.ignore_patterns("panes", "gt"))
    for path in sorted((SCENE / "images").iterdir())[:3]:
        shutil.copy(path, root / "photographs")
    return root


@pytest.fixture(scope="module")
def refused(places: Path) -> dict[str, Found]:
    """Results of the command lines that can be refused at once."""
    return dict(zip(REFUSED, found_of([line.split() for line in REFUSED], ["torch", "numba"], places), strict=True))


@pytest.mark.parametrize("line", REFUSED)
def test_simple_errors_are_reported_without_importing_pytorch(line: str, refused: dict[str, Found]) -> None:
    found = refused[line]
    assert (found.code, found.slow) == (2, [])
    assert REFUSED[line] in " ".join(found.err.split()) and found.err.startswith("error: ")


WITHOUT_PYTORCH = """
import importlib.abc, sys

class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "torch":
            raise OSError("PyTorch was imported")

sys.meta_path.insert(0, Missing())
"""
FIRST_WORDS = {
    "train splat --data SCENE --output new": "a COLMAP capture of 64 photographs",
    "train planar --preset paper --data=SCENE --output new": "8 masks of panes",
    "demo --output new": "training planar",
    "info SCENE": "a capture format: COLMAP points: 5972",
    "info run": "a planar run capture: gone iterations: 3000",
    "eval run": "run: a planar run of 3000 iterations on gone",
    "render run --output new": "run: a planar run of 3000 iterations on gone",
    "dereflect run --output new": "run: a planar run of 3000 iterations on gone",
    "clean run --output new": "run: a planar run of 3000 iterations on gone",
    "export run --output new": "run: a planar run of 3000 iterations on gone",
    "video run --output film.gif": "run: a planar run of 3000 iterations on gone",
    "view splats.ply": "splats.ply: a splat file of 0.0 MB",
    "info splats.ply": "a splat file bytes: 0",
}
"""Command lines, and their output before they need PyTorch."""


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Found]:
    """Output of each command line until it needs PyTorch, which cannot be imported; each has its own output folder."""
    folder = tmp_path_factory.mktemp("begun")
    (folder / "splats.ply").write_bytes(b"")
    (folder / "run").mkdir()
    (folder / "run" / "recipe.json").write_text(recipe_to_json(PlanarRecipe()))
    (folder / "run" / "settings.json").write_text(json.dumps({"data": "gone", "iterations": 3000}))
    lines = [
        line.replace("SCENE", str(SCENE)).replace("--output new", f"--output new{number}").split()
        for number, line in enumerate(FIRST_WORDS)
    ]
    return dict(zip(FIRST_WORDS, found_of(lines, [], folder, WITHOUT_PYTORCH), strict=True))


@pytest.mark.parametrize("line", FIRST_WORDS)
def test_a_command_begins_before_pytorch_is_imported(line: str, begun: dict[str, Found]) -> None:
    assert FIRST_WORDS[line] in " ".join(begun[line].out.split())
    assert (begun[line].code, begun[line].err) == (1, "stopped: PyTorch was imported\n")


def test_photographs_are_described_without_pytorch(places: Path) -> None:
    (found,) = found_of([["info", "photographs"]], ["torch", "numba"], places)
    assert (found.code, found.slow) == (0, [])
    assert "photographs without poses" in found.out


def test_a_command_imports_no_other(tmp_path: Path) -> None:
    (found,) = found_of([["eval", str(tmp_path)]], SLOW)
    assert found.code == 2
    assert "glassplat.cli.scene" in found.commands
    assert not {"glassplat.cli.capture", "glassplat.cli.info", "glassplat.cli.train"} & found.commands


@pytest.mark.parametrize(
    "arguments",
    [
        ["train"],
        ["train", "splat"],
        ["train", "nerf", "--data", "x", "--output", "y"],
        ["eval"],
        ["eval", "run", "--device", "tpu"],
        ["render", "run"],
        ["render", "run", "--output", "x", "--split", "most"],
        ["dereflect", "run", "--output", "x", "--source", "[bold]"],
        ["demo", "--iterations", "many"],
    ],
    ids=" ".join,
)
def test_options_that_cannot_be_understood_end_with_code_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("error: ") and f"glassplat {arguments[0]}" in said


def test_completions_for_a_shell_know_the_options_of_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--tyro-print-completion", "bash"])
    said = capsys.readouterr().out
    assert "--mask-polarity" in said and "--layers" in said


SHELL = {
    "glassplat --help >&-": (0, ""),
    "glassplat trian 2>&-": (2, ""),
    "glassplat --version >&- 2>&-": (0, ""),
    "glassplat eval none 2>/dev/full": (2, ""),
    "glassplat --help >/dev/full": (1, "stopped: no space left on device; free some space\n"),
    "PYTHONIOENCODING=ascii glassplat --help >/dev/null": (0, ""),
    "LC_ALL=C PYTHONUTF8=0 glassplat [bold]-ä 2>/dev/null": (2, ""),
}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the machine has no device that is always full")
@pytest.mark.parametrize(("line", "expected"), SHELL.items(), ids=SHELL)
def test_output_that_is_closed_full_or_narrow_changes_no_exit_code(line: str, expected: tuple[int, str]) -> None:
    line = line.replace("glassplat", f"{sys.executable} -m glassplat")
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == expected


@pytest.mark.parametrize("words", [["--help"], ["info", str(Path(glassplat.__file__).parent / "demo_scene")]])
def test_a_closed_pipe_ends_the_command_silently(words: list[str]) -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "glassplat", *words]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")
