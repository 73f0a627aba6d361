"""Hashes of all that each method learns, renders and exports, to show that a code change preserves every bit.

    NUMBA_NUM_THREADS=1 python tools/same_bits.py --write before.json
    NUMBA_NUM_THREADS=1 python tools/same_bits.py --compare before.json

It trains small scenes for 100 steps and uses only the command line, so it survives refactoring of the package. Cases,
layers and values that a commit has removed are listed, and do not count as differences. The scenes are made once and
kept in `--scenes`. To compare two commits, run the same file with PYTHONPATH set to either tree.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
ITERATIONS = 100
LAYERS = (
    *("rgb", "transmission", "without_panes", "reflection", "strength", "mask", "depth", "alpha", "base", "normal"),
    *("environment", "surroundings", "median_depth", "photographed"),
)
NAMES_RUN = "glassplat.json"
"""File that contains the location of the run, which differs every time."""
FORMATS = ("ply", "spz", "glb", "html")
BLOCK = re.compile(r'<script type="([^"]+)" id="([^"]+)">(.*?)</script>', re.DOTALL)
Hashes = dict[str, str]


class Case(NamedTuple):
    """One run: the scene, and the arguments of `glassplat train`."""

    scene: str
    arguments: str


GLOSSY = "--downscale 3 --least-iterations 1 --texels 16 --first-texels 8"
CASES: dict[str, Case] = {
    "splat": Case("demo", "splat"),
    "splat-paper": Case("demo", "splat --preset paper"),
    "splat-mcmc": Case("demo", "splat --strategy mcmc"),
    "splat-discs": Case("demo", "splat --primitive disc"),
    "splat-photographs": Case("ignored", "splat --exposure.rate 1e-3 --poses.rate 1e-3"),
    "planar": Case("demo", "planar"),
    "planar-panes": Case("screens", "planar --tint"),
    "planar-paper": Case("screens", "planar --preset paper"),
    "planar-mcmc": Case("screens", "planar --strategy mcmc"),
    "planar-photographs": Case("ignored", "planar --photographer.learn --exposure.rate 1e-3 --poses.rate 1e-3"),
    "deferred": Case("ball", f"deferred {GLOSSY}"),
    "deferred-mcmc": Case("ball", f"deferred {GLOSSY} --strategy mcmc --exposure.rate 1e-3 --poses.rate 1e-3"),
    "deferred-paper": Case("ball", f"deferred --preset paper {GLOSSY}"),
    "traced": Case("ball", f"traced {GLOSSY}"),
    "traced-discs": Case("ball", f"traced {GLOSSY} --primitive disc"),
    "traced-paper": Case("ball", f"traced --preset paper {GLOSSY} --surroundings.start.cells 6"),
}


def digest(content: bytes | str) -> str:
    """First 16 hexadecimal digits of the SHA-256."""
    return hashlib.sha256(content if isinstance(content, bytes) else content.encode()).hexdigest()[:16]


def glassplat(arguments: Iterable[str]) -> str | None:
    """Runs a command in this process; returns the end of its output if it fails."""
    said, before = io.StringIO(), sys.argv
    sys.argv = ["glassplat", *arguments]
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            runpy.run_module("glassplat", run_name="__main__")
    except SystemExit as end:
        return " ".join(said.getvalue().split())[-300:] or "no message" if end.code else None
    finally:
        sys.argv = before
    return None


def leaves(value: Any, name: str) -> Iterator[tuple[str, str]]:
    """Values of a JSON document by their paths, so that removed values leave the others comparable."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{name}.{key}")
    elif isinstance(value, list) and any(isinstance(inner, dict) for inner in value):
        for index, inner in enumerate(value):
            yield from leaves(inner, f"{name}.{index}")
    else:
        yield name, digest(json.dumps(value))


def hashes_of_file(path: Path, name: str) -> Iterator[tuple[str, str]]:
    """Hashes of the contents of a file: each value of JSON, and only the data of a web page, not its code."""
    if path.suffix == ".json":
        yield from leaves(json.loads(path.read_text()), name)
    elif path.suffix == ".html":
        for kind, block, content in BLOCK.findall(path.read_text()):
            part = f"{name}#{block}"
            yield from leaves(json.loads(content), part) if kind == "application/json" else [(part, digest(content))]
    elif path.suffix == ".png":
        yield name, digest(np.asarray(Image.open(path)).tobytes())
    else:
        yield name, digest(path.read_bytes())


def hashes_of_folder(folder: Path, name: str) -> Iterator[tuple[str, str]]:
    """Hashes of all files in a folder."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != NAMES_RUN:
            yield from hashes_of_file(path, f"{name}/{path.relative_to(folder)}")


def hashes_of_log(path: Path, name: str) -> Iterator[tuple[str, str]]:
    """Hashes of the curve of each loss and of the number of Gaussians."""
    curves: dict[str, list[Any]] = {}
    for line in path.read_text().splitlines():
        message = json.loads(line)
        if message.get("message") == "StepDone":
            terms = {"loss": message["loss"], **message["losses"], **message["counts"], "view": message["view"]}
            for term, value in terms.items():
                curves.setdefault(term, []).append(value)
    for term, values in curves.items():
        yield f"{name}/{term}", digest(json.dumps(values))


def hashes_of_case(name: str, scenes: Path, work: Path, iterations: int) -> Hashes:
    """Trains, renders and exports one case."""
    case, run = CASES[name], work / name
    method, *options = case.arguments.split()
    common = ["--data", str(scenes / case.scene), "--output", str(run), "--iterations", str(iterations)]
    failure = glassplat(["train", method, *common, "--device", "cpu", *options])
    if failure:
        return {f"{name}/failed": failure}
    found = dict(hashes_of_log(run / "log.jsonl", f"{name}/log"))
    found |= hashes_of_folder(run / "point_cloud", f"{name}/scene")
    for layer in LAYERS:
        output = run / "layers" / layer
        if not glassplat(["render", str(run), "--layers", layer, "--device", "cpu", "--output", str(output)]):
            found |= hashes_of_folder(output, f"{name}/render")
    for kind in FORMATS:
        output = run / "export" / kind
        if not glassplat(["export", str(run), "--formats", kind, "--device", "cpu", "--output", str(output)]):
            found |= hashes_of_folder(output, f"{name}/export")
    return found


def make_scenes(folder: Path) -> None:
    """Makes missing scenes: reduced copies of the bundled ones, and a scene with three panes."""
    import glassplat as package

    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "demo").exists():
        shrink(Path(package.__file__).parent / "demo_scene", folder / "demo.part")
        (folder / "demo.part").rename(folder / "demo")
    if not (folder / "ball").exists():
        shutil.copytree(ROOT / "tests" / "data_files" / "ball", folder / "ball")
    if not (folder / "screens").exists():
        command = [sys.executable, "-m", "tools.make_pane_scene", "--output", str(folder / "screens.part")]
        sizes = ["--width", "64", "--views", "24", "--points", "1500"]
        subprocess.run([*command, *sizes], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)
        (folder / "screens.part").rename(folder / "screens")
    if not (folder / "ignored").exists():
        shutil.copytree(folder / "screens", folder / "ignored.part")
        ignore_corner(folder / "ignored.part")
        (folder / "ignored.part").rename(folder / "ignored")


def shrink(source: Path, target: Path, factor: int = 10) -> None:
    """Copies a COLMAP text capture with photographs and masks reduced by `factor`, and every third point."""
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("gt"))
    for path in [*target.glob("images/*"), *target.glob("panes/*"), *target.glob("masks/*")]:
        image = Image.open(path)
        how = Image.Resampling.NEAREST if path.parent.name in ("panes", "masks") else Image.Resampling.BOX
        image.resize((image.width // factor, image.height // factor), how).save(path)
    cameras = target / "sparse" / "0" / "cameras.txt"
    lines = []
    for line in cameras.read_text().splitlines():
        if line and not line.startswith("#"):
            identity, model, width, height, *lens = line.split()
            small = [str(float(value) / factor) for value in lens]
            line = " ".join([identity, model, str(int(width) // factor), str(int(height) // factor), *small])
        lines.append(line)
    cameras.write_text("\n".join(lines) + "\n")


def ignore_corner(capture: Path) -> None:
    """Writes masks that exclude a corner of every photograph from training."""
    (capture / "ignore").mkdir()
    for path in sorted((capture / "images").iterdir()):
        mask = np.zeros(np.asarray(Image.open(path)).shape[:2], np.uint8)
        mask[:12, :16] = 255
        Image.fromarray(mask).save(capture / "ignore" / f"{path.name}.png")


def compared(before: Hashes, now: Hashes) -> int:
    """Prints differing and removed values; returns the number of differing values."""
    gone = sorted(set(before) - set(now))
    failed = {name.split("/")[0]: said for name, said in now.items() if name.endswith("/failed")}
    differ = [name for name in before if name in now and before[name] != now[name] and not name.endswith("/failed")]
    same = sum(before[name] == now[name] for name in before if name in now)
    print(f"{same} values are the same, {len(differ)} differ, {len(gone)} are gone, {len(set(now) - set(before))} new")
    for case, said in failed.items():
        print(f"  refused: {case}: {said}")
    for name in [name for name in gone if name.split("/")[0] not in failed][:40]:
        print(f"  gone: {name}")
    for case in dict.fromkeys(name.split("/")[0] for name in differ):
        mine = [name for name in differ if name.startswith(f"{case}/")]
        print(f"  differ: {case}: {len(mine)}, first {', '.join(mine[:3])}")
    return len(differ)


def main() -> int:
    """Hashes all cases; returns 1 if `--compare` finds a difference."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--write", type=Path, help="file for the hashes")
    parser.add_argument("--compare", type=Path, help="file of hashes to compare with")
    parser.add_argument("--scenes", type=Path, default=Path(tempfile.gettempdir()) / "same_bits_scenes")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="cases")
    parser.add_argument("--iterations", type=int, default=ITERATIONS, help="length of each run")
    arguments = parser.parse_args()
    make_scenes(arguments.scenes)
    found: Hashes = {}
    with tempfile.TemporaryDirectory() as work:
        for name in arguments.only:
            start = time.perf_counter()
            hashes = hashes_of_case(name, arguments.scenes, Path(work), arguments.iterations)
            found |= hashes
            if arguments.write:
                arguments.write.write_text(json.dumps(found, indent=1))
            told = next((f"FAILED: {said}" for key, said in hashes.items() if key.endswith("/failed")), "")
            print(f"{name}: {len(hashes)} values, {time.perf_counter() - start:.1f} s {told}", flush=True)
    if not arguments.compare:
        return 0
    before = json.loads(arguments.compare.read_text())
    return min(
        1, compared({name: value for name, value in before.items() if name.split("/")[0] in arguments.only}, found)
    )


if __name__ == "__main__":
    sys.exit(main())
