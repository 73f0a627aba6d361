"""Unusual machines: no home directory, other locales, odd names, a damaged kernel cache, few and many threads."""

from __future__ import annotations

import os
import random
import shutil
import stat
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import cache
from pathlib import Path

from tests.cli.tiny_run import write_run
from tools.trial import Case
from tools.trial_process import ROOT, run, small_disk

KINDS = ("home", "locale", "name", "cache", "two", "threads", "columns", "temporary")
ONE_CACHE = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
"""Environment in which kernels are loaded only from NUMBA_CACHE_DIR, not from the bundled cache."""
DAMAGED, MOST_FILLINGS = 3, 4
LOCALES = ("C", "POSIX", "tr_TR.UTF-8", "de_DE.ISO-8859-1", "C.UTF-8", "nonsense", "")
NAMES = ("a b", "a\nb", "\N{GRINNING FACE}", "[bold]x[/bold]", "-x", "a'b\"c", "%s{0}", "é" * 80, "a\tb", "\udcff")


def cases(seed: int, cases: int, place: Path) -> Iterator[Case]:
    """Renders one small run in various environments, and compares the images with those of the normal one."""
    scene = write_run(place / "run")
    ended = run(["render", scene, "--output", place / "ours", "--device", "cpu"])
    if ended.code != 0:
        raise RuntimeError(f"nothing is rendered at all: {ended.output[-500:]}")
    truth = pictures(place / "ours")
    for number in range(cases):
        draw, folder = random.Random(f"{seed} {number}"), place / f"case {number}"
        folder.mkdir()
        kind = KINDS[number % len(KINDS)]
        with ExitStack() as disks:
            if kind == "cache":  # Root can write into any folder, but not to a read-only disk.
                change = disks.enter_context(small_disk(folder / "kernels", 1 << 20))
            what, environment, source = machine(kind, draw, folder, scene)
            if what == "read-only":
                change("ro")
            yield Case(f"{number} {kind} {what!r}", tried(environment, source, folder, truth, twice=kind == "two"))
        for path in folder.rglob("*"):
            if path.is_dir() and not path.is_symlink():
                path.chmod(stat.S_IRWXU)
        shutil.rmtree(folder, ignore_errors=True)


def pictures(folder: Path) -> dict[str, bytes]:
    """Images in a folder, by name."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.png"))}


def machine(kind: str, draw: random.Random, folder: Path, scene: Path) -> tuple[str, Mapping[str, str], Path]:
    """Description of an unusual environment, its variables, and the run to render."""
    known = dict(os.environ)
    kernels = folder / "kernels"
    if kind == "home":
        what = draw.choice(("", "/nowhere", "/proc", "relative", "none"))
        known.pop("HOME") if what == "none" else known.update(HOME=what)
        known.update(XDG_CACHE_HOME="/proc/none")
    elif kind == "locale":
        what = draw.choice(LOCALES)
        known.update(LC_ALL=what, LANG=what, PYTHONUTF8=draw.choice(("0", "1")))
        known.pop("PYTHONIOENCODING", None)
    elif kind == "name":
        what = draw.choice(NAMES)
        place = folder / os.fsencode(what).decode("utf-8", "surrogateescape")
        shutil.copytree(scene, place)
        return what, known, place
    elif kind == "cache":
        what = draw.choice(("cut", "garbage", "empty", "read-only", "a file"))
        damaged_cache(what, draw, kernels / "cache", scene)
        known.update(NUMBA_CACHE_DIR=str(kernels / "cache"))
        if what in ("cut", "garbage", "empty"):
            known.update(ONE_CACHE)
    elif kind == "two":
        what = "missing"
        damaged_cache(what, draw, kernels, scene)
        known.update(ONE_CACHE, NUMBA_CACHE_DIR=str(kernels))
    elif kind == "threads":
        what = draw.choice(("1", "2", "3", "7"))
        known.update(NUMBA_NUM_THREADS=what, OMP_NUM_THREADS=what)
    elif kind == "columns":
        what = draw.choice(("0", "1", "-5", "100000", "x"))
        known.update(COLUMNS=what, TERM=draw.choice(("dumb", "", "xterm-256color", "nonsense")))
    else:
        what = draw.choice(("/nowhere", str(folder / "none"), "/proc"))
        known.update(TMPDIR=what)
    return what, known, scene


def damaged_cache(what: str, draw: random.Random, kernels: Path, scene: Path) -> None:
    """Damages a filled cache: few files only, if their contents have to be compiled again."""
    if what == "a file":
        kernels.write_text("x")
        return
    shutil.copytree(filled_cache(scene), kernels)
    files = sorted(path for path in kernels.rglob("*") if path.is_file())
    for path in draw.sample(files, len(files) // 2 if what == "read-only" else min(DAMAGED, len(files))):
        data = path.read_bytes()
        if what == "missing":
            path.unlink()
        elif what == "garbage":
            path.write_bytes(draw.randbytes(len(data)))
        elif what != "read-only" or draw.random() < 0.5:  # Half of the files in a read-only cache are truncated too.
            path.write_bytes(b"" if what == "empty" else data[: draw.randrange(len(data) + 1)])


@cache
def filled_cache(scene: Path) -> Path:
    """A cache with all kernels needed to render a scene; it is reused, because filling it takes minutes."""
    folder = ROOT / "runs" / "trial" / "kernels"
    environment = dict(os.environ) | {"NUMBA_CACHE_DIR": str(folder)} | ONE_CACHE
    for _ in range(MOST_FILLINGS):
        ended = run(
            ["render", scene, "--output", scene.with_name("filling"), "--device", "cpu"], environment=environment
        )
        if ended.code == 0:
            return folder
    raise RuntimeError(f"no cache can be filled: {ended.output[-500:]}")


def tried(environment: Mapping[str, str], scene: Path, folder: Path, truth: dict[str, bytes], *, twice: bool) -> str:
    """Renders in an environment, once or twice concurrently; returns the fault."""
    outputs = [folder / "one", folder / "other"][: 2 if twice else 1]

    def rendered(output: Path) -> str:
        # An absolute path, because a name with a leading dash would be read as an option.
        ended = run(["render", scene.absolute(), "--output", output, "--device", "cpu"], environment=environment)
        if ended.fault() or ended.code != 0:
            return ended.fault() or f"code {ended.code}: {ended.output[-300:]}"
        return "" if pictures(output) == truth else "images differ from those of the normal environment"

    with ThreadPoolExecutor(2) as pool:
        return "; ".join(fault for fault in pool.map(rendered, outputs) if fault)
