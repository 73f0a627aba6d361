"""Commands that end at any moment: killed, interrupted, out of disk, or with their output taken away.

What is left is never a half-written file that is taken for whole: `glassplat info` reads it without a traceback, and a
training that is resumed ends with the same bits as one that nobody disturbed.
"""

from __future__ import annotations

import hashlib
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.training.tiny_capture import write_tiny_capture
from tools.trial import Case
from tools.trial_process import Ended, Sent, run

METHODS = ("splat", "planar", "deferred", "traced")
STEPS = 120
KINDS = ("kill", "kill", "kill", "disk", "interrupt", "interrupt", "twice", "gone", "read-only", "write")


def cases(seed: int, cases: int, place: Path) -> Iterator[Case]:
    """Mostly trainings; each method is trained undisturbed when it is first needed."""
    data = write_tiny_capture(place / "capture")
    whole: dict[str, tuple[str, float]] = {}
    for number in range(cases):
        draw = random.Random(f"{seed} {number}")
        method, kind = METHODS[number % len(METHODS)], draw.choice(KINDS)
        if method not in whole:
            whole[method] = undisturbed(method, data, place / method)
        folder = place / str(number)
        digest, seconds = whole[method]
        yield Case(
            f"{number} {method} {kind}", tried(kind, draw, (method, data, folder), (digest, seconds, place / method))
        )
        shutil.rmtree(folder, ignore_errors=True)


def training(method: str, data: Path, run_folder: Path, *more: str) -> Sequence[str | Path]:
    """Options of a short training with many checkpoints."""
    return [
        "train", method, "--data", data, "--output", run_folder, "--iterations", str(STEPS), "--device", "cpu",
        "--checkpoint-every", "0.05", *more,
    ]  # fmt: skip


def undisturbed(method: str, data: Path, folder: Path) -> tuple[str, float]:
    """Digest of the scene of a training that ends by itself, and the seconds it takes."""
    run(training(method, data, folder))  # Kernels are compiled.
    shutil.rmtree(folder)
    begun = time.monotonic()
    ended = run(training(method, data, folder))
    if ended.code != 0:
        raise RuntimeError(f"{method} cannot be trained at all: {ended.output[-500:]}")
    return digest_of(folder), time.monotonic() - begun


def digest_of(folder: Path) -> str:
    """Digest of all files of a run's last scene."""
    digest = hashlib.sha256()
    for path in sorted((folder / "point_cloud" / f"iteration_{STEPS}").rglob("*")):
        if path.is_file():
            digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def tried(kind: str, draw: random.Random, asked: tuple[str, Path, Path], whole: tuple[str, float, Path]) -> str:
    """Fault of a command's end and of what it left."""
    method, data, folder = asked
    digest, seconds, done = whole
    moment = draw.uniform(0.2, 1.0) * seconds
    if kind == "write":
        return written(draw, done, folder)
    if kind == "gone":
        return taken_away(draw, training(method, data, folder), folder, moment)
    if kind == "twice":
        return two_at_once(training(method, data, folder), folder, digest)
    if kind == "read-only":
        folder.write_text("a file")
        return run(training(method, data, folder)).fault()
    if kind == "disk":
        ended = run(training(method, data, folder), largest_file=draw.choice((0, 100, 3000, 20_000, 60_000)))
    else:
        times = 1 if kind == "kill" else draw.randint(2, 4)
        sent = Sent(signal.SIGKILL if kind == "kill" else signal.SIGINT, moment, times, 0.5 / times)
        ended = run(training(method, data, folder), sent=sent)
    return ended.fault() or resumed(method, data, folder, digest)


def resumed(method: str, data: Path, folder: Path, digest: str) -> str:
    """Fault of a run that goes on; one that has nothing to go on from begins again."""
    if folder.exists():
        fault = run(["info", folder]).fault()
        if fault:
            return f"info: {fault}"
    ended = run(training(method, data, folder, "--resume"))
    if ended.code != 0:
        return f"resumed: {ended.fault() or ended.output[-500:]}"
    return "" if digest_of(folder) == digest else "resumed, it ended with other bits"


def written(draw: random.Random, done: Path, folder: Path) -> str:
    """Something is made of a finished run, killed or out of disk on the way, and made again."""
    shutil.copytree(done, folder / "run")
    command: list[str | Path] = draw.choice(
        (
            ["eval", folder / "run"],
            ["export", folder / "run", "--output", folder / "exported"],
            ["render", folder / "run", "--output", folder / "pictures"],
            [
                "video",
                folder / "run",
                "--output",
                folder / "film.webp",
                "--seconds",
                "0.5",
                "--fps",
                "8",
                "--width",
                "64",
            ],
        )
    )
    is_full = draw.random() < 0.5
    first = run(
        [*command, "--device", "cpu"],
        sent=None if is_full else Sent(signal.SIGKILL, draw.uniform(1, 8)),
        largest_file=draw.choice((0, 100, 1000)) if is_full else None,
    )
    if first.fault():
        return f"{command[0]}: {first.fault()}"
    if command[0] == "video":
        command.append("--force")
    again = run([*command, "--device", "cpu"])
    return "" if again.code == 0 else f"{command[0]} again: {again.fault() or again.output[-400:]}"


def taken_away(draw: random.Random, command: Sequence[str | Path], folder: Path, moment: float) -> str:
    """The output is removed, or replaced by a file, while the command works."""
    script = f"sleep {moment:.2f}; rm -rf '{folder}'" + ("" if draw.random() < 0.5 else f"; echo x > '{folder}'")
    with subprocess.Popen(["sh", "-c", script]) as remover:
        ended = run(command)
        remover.wait()
    folder.unlink() if folder.is_file() else None
    return ended.fault()


def two_at_once(command: Sequence[str | Path], folder: Path, digest: str) -> str:
    """Two processes train into one folder: one does, the other one is refused."""
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(2) as pool:
        ended: list[Ended] = list(pool.map(lambda _: run(command), range(2)))
    faults = "; ".join(fault for one in ended if (fault := one.fault()))
    if faults:
        return faults
    if 0 not in [one.code for one in ended]:
        return f"neither was done: {[one.output[-200:] for one in ended]}"
    return "" if digest_of(folder) == digest else "together they ended with other bits"
