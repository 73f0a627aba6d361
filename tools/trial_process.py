"""Commands in separate processes with limited memory and time, for `tools/trial.py`."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

ROOT = Path(__file__).parent.parent
MOST_BYTES, MOST_SECONDS = 8 << 30, 600
GOOD_CODES = (0, 1, 2, 129, 130, 141, 143, -signal.SIGINT)  # The last one if Ctrl-C arrives during the exit of Python.
COMPLAINTS = ("Traceback (most recent call last)", "unexpected error", "Fatal Python error", "terminate called")


@dataclass(frozen=True)
class Ended:
    """Result of a command; `code` is None if it was killed, on purpose or after a timeout."""

    code: int | None
    output: str
    is_late: bool = False

    def fault(self) -> str:
        """Fault of the result; none if it was intended, or gave one readable message."""
        if self.is_late:
            return f"it did not end in {MOST_SECONDS} s: {self.output[-300:]!r}"
        if any(word in self.output for word in COMPLAINTS):
            return f"a traceback: {self.output[-1500:]}"
        if self.code is not None and self.code not in GOOD_CODES:
            return f"code {self.code}: {self.output[-300:]!r}"
        return "it failed and said nothing" if self.code in (1, 2) and not self.output.strip() else ""


@dataclass(frozen=True)
class Sent:
    """Signals to a command: their delay in seconds, their number, and the seconds between them."""

    signal: int
    after: float
    times: int = 1
    between: float = 0.1


def run(
    options: Sequence[str | Path],
    *,
    sent: Sent | None = None,
    environment: Mapping[str, str] | None = None,
    largest_file: int | None = None,
) -> Ended:
    """Runs `glassplat` with these options.

    Args:
        options: arguments of the command line.
        sent: signals to send while it runs.
        environment: replaces the current one; this tree is prepended to its PYTHONPATH.
        largest_file: bytes after which a write fails, as on a full disk.
    """

    def bound() -> None:
        bound_memory()
        if largest_file is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

    known = dict(os.environ if environment is None else environment)
    known["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), known.get("PYTHONPATH"))))
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "glassplat", *map(str, options)],
            stdout=subprocess.PIPE if largest_file is not None else log,  # The limit does not apply to pipes.
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=known,
            preexec_fn=bound,  # noqa: PLW1509 - No other thread runs here.
        )
        begun = time.monotonic()
        if sent is not None:
            _send(process, sent)
        try:
            piped = process.communicate(timeout=MOST_SECONDS - (time.monotonic() - begun))[0] or b""
            is_late = False
        except subprocess.TimeoutExpired:
            process.kill()
            piped, is_late = process.communicate()[0] or b"", True
        log.seek(0)
        output = (piped + log.read()).decode(errors="replace")
    code = process.returncode
    return Ended(None if is_late or code == -signal.SIGKILL else code, output, is_late)


def bound_memory() -> None:
    """Limits the address space of this process to `MOST_BYTES`."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))


def run_forked(options: Sequence[str | Path], act: Callable[[int], None] = lambda pid: None) -> Ended:
    """As `run`, in a fork of this process, in which slow imports are done.

    Args:
        options: arguments of the command line.
        act: called with the process id while the command runs, to disturb it or its files.
    """
    with tempfile.TemporaryFile() as log:
        process = get_context("fork").Process(target=_command, args=([*map(str, options)], log.fileno()))
        sys.stdout.flush()
        process.start()
        act(int(process.pid or 0))
        process.join(MOST_SECONDS)
        is_late = process.is_alive()
        process.kill()
        process.join()
        log.seek(0)
        output = log.read().decode(errors="replace")
    code = process.exitcode
    return Ended(None if is_late or code == -signal.SIGKILL else code, output, is_late)


def _command(options: list[str], log: int) -> None:
    """Runs a command of glassplat in the forked process."""
    from glassplat.cli.main import main

    bound_memory()
    for stream in (1, 2):
        os.dup2(log, stream)
    sys.stdin = open(os.devnull)  # noqa: SIM115 - Stays open until the process ends.
    sys.exit(main(options))


@contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[Callable[[str], None]]:
    """Mounts a small file system at a new folder; yields a function that changes its options, such as `size=1g`.

    Raises:
        PermissionError: the user is not root.
    """
    if os.geteuid() != 0:
        raise PermissionError("only the administrator may mount a small disk; run the trial as such, in a container")
    folder.mkdir(parents=True)

    def mount(*options: str) -> None:
        subprocess.run(["mount", "-t", "tmpfs", *options, "trial", str(folder)], check=True, capture_output=True)

    mount("-o", f"size={kilobytes}k")
    try:
        yield lambda changed: mount("-o", f"remount,{changed}")
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)
        folder.rmdir()


def _send(process: subprocess.Popen[bytes], sent: Sent) -> None:
    try:
        process.wait(sent.after)
    except subprocess.TimeoutExpired:
        for _ in range(sent.times):
            process.send_signal(sent.signal)
            time.sleep(sent.between)
