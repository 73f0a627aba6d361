"""Commands that end at a random moment: killed, interrupted, out of disk, or with their output removed.

No half-written file may be treated as complete: `glassplat info` reads what is left without a traceback, and a resumed
training ends with the same bits as an undisturbed one. Full and read-only disks are small file systems in memory, which
only root can mount.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

from glassplat.annotate.document import read_document
from glassplat.annotate.session import ChangedElsewhereError, open_session
from tests.annotate.conftest import write_room
from tests.prepare.conftest import copy_photographs
from tests.training.tiny_capture import write_tiny_capture
from tools.trial import Case
from tools.trial_process import Ended, Sent, run, run_forked, small_disk

METHODS = ("splat", "planar", "deferred", "traced")
STEPS = 60
CHECKPOINT = "checkpoint.safetensors"
MOST_LOST = 120.0
"""Maximum seconds of training that a kill may lose."""
TIMES = """
import random, time
shift, truth = random.Random(0), (time.time, time.time_ns)
time.time = lambda: truth[0]() + shift.uniform(-1e6, 1e6)
time.time_ns = lambda: truth[1]() + shift.randint(-10**15, 10**15)
"""
"""Module that makes the clock jump by days at every call."""


class Integer(NamedTuple):
    """An undisturbed training."""

    method: str
    data: Path
    folder: Path
    digests: frozenset[tuple[str, str]]
    seconds: float


def cases(seed: int, cases: int, place: Path) -> Iterator[Case]:
    """Mostly trainings; each method is trained undisturbed on first use."""
    for module in ("runs", "evaluation", "writing", "details"):  # Slow imports happen before processes fork.
        importlib.import_module(f"glassplat.cli.{module}")
    data = place / "capture"
    made_apart(write_tiny_capture, data)

    @cache
    def whole(method: str) -> Integer:
        return undisturbed(method, data, place / method)

    for number in range(cases):
        draw = random.Random(f"{seed} {number}")
        method, kind = draw.choice(METHODS), KINDS[number % len(KINDS)]
        folder = place / str(number)
        yield Case(f"{number} {method} {kind.__name__}", kind(draw, whole(method), folder))
        shutil.rmtree(folder, ignore_errors=True)


def made_apart(write: Callable[[Path], object], folder: Path) -> None:
    """Writes a folder in a fork: threads do not survive forks, so this process must not compute tensors."""
    writer = get_context("fork").Process(target=write, args=(folder,))
    writer.start()
    writer.join()


def training(whole: Integer, folder: Path, *more: str) -> Sequence[str | Path]:
    """Options of a short training with a checkpoint after every step."""
    return [
        "train", whole.method, "--data", whole.data, "--output", folder, "--iterations", str(STEPS), "--device", "cpu",
        "--checkpoint-every", "0.001", *more,
    ]  # fmt: skip


def undisturbed(method: str, data: Path, folder: Path) -> Integer:
    """Runs a training to its end; the first one compiles kernels."""
    for _ in range(2):
        shutil.rmtree(folder, ignore_errors=True)
        begun = time.monotonic()
        ended = run_forked(training(Integer(method, data, folder, frozenset(), 0), folder))
        if ended.code != 0:
            raise RuntimeError(f"{method} cannot be trained: {ended.output[-500:]}")
    return Integer(method, data, folder, digests_of(folder), time.monotonic() - begun)


def digests_of(folder: Path) -> frozenset[tuple[str, str]]:
    """Names and digests of all files of the last scene of a run."""
    files = (path for path in (folder / "point_cloud" / f"iteration_{STEPS}").rglob("*") if path.is_file())
    return frozenset((path.name, hashlib.sha256(path.read_bytes()).hexdigest()) for path in files)


def other_bits(folder: Path, whole: Integer) -> str:
    """Fault of a run whose final files differ from those of the undisturbed run, with their names."""
    differing = digests_of(folder) ^ whole.digests
    return f"the result has other bits: {sorted({name for name, _ in differing})}" if differing else ""


def resumed(whole: Integer, folder: Path) -> str:
    """Resumes a run, or restarts it without a checkpoint; returns its fault."""
    if folder.exists():
        fault = run_forked(["info", folder]).fault()
        if fault:
            return f"info: {fault}"
    ended = run_forked(training(whole, folder, *(["--resume"] if (folder / CHECKPOINT).exists() else [])))
    if ended.code != 0:
        return f"resumed: {ended.fault() or ended.output[-500:]}"
    return other_bits(folder, whole)


def wait_for_moment(draw: random.Random, whole: Integer, folder: Path) -> None:
    """Waits for a random moment of a training, in two of three cases after its first checkpoint."""
    if draw.random() < 1 / 3:
        time.sleep(draw.uniform(0, whole.seconds))
        return
    end = time.monotonic() + 5 * whole.seconds
    while not (folder / CHECKPOINT).exists() and time.monotonic() < end:
        time.sleep(0.005)
    time.sleep(draw.uniform(0, 0.4 * whole.seconds))


def killed(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Kills a training, which may lose little."""

    def kill(pid: int) -> None:
        wait_for_moment(draw, whole, folder)
        os.kill(pid, signal.SIGKILL)

    ended = run_forked(training(whole, folder), act=kill)
    checkpoint = folder / CHECKPOINT
    if checkpoint.exists() and time.time() - checkpoint.stat().st_mtime > MOST_LOST:
        return "more than two minutes of training were lost"
    return ended.fault() or resumed(whole, folder)


def interrupted(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Sends Ctrl-C one to four times within half a second."""
    times = draw.randint(1, 4)
    sent = Sent(signal.SIGINT, draw.uniform(0, 2 * whole.seconds + 3), times, 0.5 / times)
    return run(training(whole, folder), sent=sent).fault() or resumed(whole, folder)


def out_of_disk(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Fills the disk at some write; later there is space."""
    with small_disk(folder, draw.choice((0, 4, 8, 16, 40, 100, 200)) + draw.randrange(1, 40)) as change:
        fault = run_forked(training(whole, folder / "run")).fault()
        change("size=1g")
        return fault or resumed(whole, folder / "run")


def read_only(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Makes the disk read-only during the training, and writable later."""
    with small_disk(folder, 1 << 20) as change:

        def protect(pid: int) -> None:
            wait_for_moment(draw, whole, folder / "run")
            for _ in range(100):
                with suppress(subprocess.CalledProcessError):  # Fails while a file is open there.
                    change("ro")
                    return
                time.sleep(0.005)

        fault = run_forked(training(whole, folder / "run"), act=protect).fault()
        change("rw,size=1g")
        return fault or resumed(whole, folder / "run")


def taken_away(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Removes the output, or replaces it by a file, while the command runs."""
    replaced = draw.random() < 0.5

    def take(pid: int) -> None:
        wait_for_moment(draw, whole, folder)
        shutil.rmtree(folder, ignore_errors=True)
        if replaced:
            with suppress(OSError):
                folder.write_text("x")

    ended = run_forked(training(whole, folder), act=take)
    if folder.is_file():
        folder.unlink()
    return ended.fault()


def two_at_once(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Two processes train into one folder: one succeeds, and the other is rejected."""
    with ThreadPoolExecutor(2) as pool:
        ended: list[Ended] = list(pool.map(lambda _: run(training(whole, folder)), range(2)))
    faults = "; ".join(fault for one in ended if (fault := one.fault()))
    if faults:
        return faults
    if 0 not in [one.code for one in ended]:
        return f"neither process succeeded: {[one.output[-200:] for one in ended]}"
    return other_bits(folder, whole)


def clock_jumps(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Trains with a clock that jumps back and forth by days."""
    site = folder.with_name(f"{folder.name}-clock")
    site.mkdir()
    (site / "sitecustomize.py").write_text(TIMES)
    ended = run(training(whole, folder), environment=dict(os.environ) | {"PYTHONPATH": str(site)})
    shutil.rmtree(site)
    if ended.code != 0:
        return ended.fault() or ended.output[-300:]
    return other_bits(folder, whole)


def killer(seconds: float) -> Callable[[int], None]:
    """Returns a function that kills a process after the given seconds."""

    def kill(pid: int) -> None:
        time.sleep(seconds)
        os.kill(pid, signal.SIGKILL)

    return kill


def written(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Runs a command on a finished run that is killed or runs out of disk, and repeats it."""
    made = folder / "made"
    film = ["--seconds", "0.5", "--fps", "8", "--width", "64"]
    name, *more = draw.choice((["eval"], ["export"], ["render"], ["video", *film]))
    output = [] if name == "eval" else ["--output", made / "film.webp" if name == "video" else made]
    command: list[str | Path] = [name, folder / "run", *output, *more, "--device", "cpu"]
    size = sum(path.stat().st_size + 4096 for path in whole.folder.rglob("*")) // 1024

    def again(fault: str) -> str:
        ended = run_forked([*command, *(["--force"] if name == "video" else [])])
        return fault or ("" if ended.code == 0 else f"{name} again: {ended.fault() or ended.output[-400:]}")

    with small_disk(folder, 1 << 20) as change:
        shutil.copytree(whole.folder, folder / "run")
        if draw.random() < 0.5:
            return again(run_forked(command, act=killer(draw.uniform(0, 4))).fault())
        change(f"size={size + draw.choice((0, 4, 16, 60))}k")
        fault = run_forked(command).fault()
        change("size=1g")
        return again(fault)


def marked(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Two programs save marks of one capture, and are killed or run out of disk: all saved marks must exist."""
    with small_disk(folder, 1 << 20) as change:
        room = folder / "room"
        made_apart(write_room, room)
        used = sum(path.stat().st_size + 4096 for path in room.rglob("*")) // 1024
        if draw.random() < 0.5:
            change(f"size={used + draw.choice((0, 4, 8, 16))}k")
        return marks_fault(draw, room, [folder.with_name(f"{folder.name}-{number}") for number in (1, 2)])


def marks_fault(draw: random.Random, room: Path, logs: Sequence[Path]) -> str:
    """Fault of marks saved by two programs at once, each with a log whose name ends in its number."""
    context = get_context("fork")
    savers = [context.Process(target=save_marks, args=(room, log)) for log in logs]
    for saver in savers:
        saver.start()
    savers[0].join(draw.uniform(0, 3))
    for saver in savers[: draw.randint(1, 2)]:
        saver.kill()
    for saver in savers:
        saver.join()
    document = read_document(room)
    there = {next(iter(pane["corners"][0].values()))[0] for pane in document["panes"]}
    told = {float(line) for log in logs if log.exists() for line in log.read_text().splitlines()}
    for log in logs:
        log.unlink(missing_ok=True)
    return f"{sorted(told - there)} were saved and are gone" if told - there else ""


def save_marks(room: Path, log: Path) -> None:
    """Adds pane after pane, each with a unique corner, and logs a line for each saved one."""
    session = open_session(room)
    with log.open("w") as lines:
        for number in range(20):
            place = float(100 * int(log.name[-1]) + number)
            known = session.describe()
            label = next(
                label for label in range(1, 65) if label not in [p["label"] for p in known["document"]["panes"]]
            )
            pane = {"label": label, "material": "glass", "shape": "rectangle", "edges": [{}] * 4, "strokes": {}}
            panes = [*known["document"]["panes"], pane | {"corners": [{"0.png": [place, 1.0]}, {}, {}, {}]}]
            asked = {"document": {"version": 1, "panes": panes}, "version": known["version"]}
            while True:
                try:
                    session.save(asked)
                    break
                except OSError:  # The disk is full, which the page reports; nothing was saved.
                    return
                except ChangedElsewhereError as changed:
                    asked = {name: changed.response[name] for name in ("document", "version")}
            print(place, file=lines, flush=True)


def prepared(draw: random.Random, whole: Integer, folder: Path) -> str:
    """Kills a preparation or lets it run out of disk, and resumes it."""
    is_killed = draw.random() < 0.5
    with small_disk(folder, 1 << 20) as change:
        photographs = copy_photographs(folder / "photographs")
        command: list[str | Path] = ["prepare", photographs, "--output", folder / "capture", "--max-size", "320"]
        if not is_killed:
            size = sum(path.stat().st_size + 4096 for path in folder.rglob("*")) // 1024
            change(f"size={size + draw.choice((0, 16, 100, 400, 1600, 3200))}k")
        ended = run_forked(command, killer(draw.uniform(0.5, 15))) if is_killed else run_forked(command)
        change("size=1g")
        return ended.fault() or prepared_again(command, folder / "capture")


def prepared_again(command: Sequence[str | Path], capture: Path) -> str:
    """Resumes an unfinished preparation; returns its fault."""
    is_begun = capture.with_name("capture.partial").exists()
    if capture.exists() and not is_begun:
        return run_forked(["info", capture]).fault()
    last = run_forked([*command, *(["--resume"] if is_begun else [])])
    return "" if last.code == 0 else f"prepare --resume: {last.fault() or last.output[-400:]}"


KINDS: tuple[Callable[[random.Random, Integer, Path], str], ...] = (
    killed, out_of_disk, interrupted, marked, killed, written, read_only, taken_away, killed, two_at_once, out_of_disk,
    killed, written, clock_jumps, killed, interrupted, marked, out_of_disk, killed, prepared,
)  # fmt: skip
