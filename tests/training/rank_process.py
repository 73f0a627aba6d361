"""One of several processes that train the tiny capture together and save their results; helpers that start them.

`torchrun` starts them as users do. Where a test does not depend on that, they are forked from a process that has
imported everything, as importing takes longer than most of their work. So is `torchrun` itself.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import runpy
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest

from glassplat.methods.recipe import RECIPES
from glassplat.training import ranks
from glassplat.training.checkpoint import save_checkpoint
from glassplat.training.loop import train
from glassplat.training.messages import Message, StepDone
from glassplat.training.ranks import Ranks, join_ranks
from glassplat.training.stage import Stage, TrainState
from tests.training.test_trainer import planar_stages
from tests.training.tiny_capture import tiny_capture

ROOT = Path(__file__).parents[2]
LONGEST = 240
"""Limit in seconds for work that takes a few on an idle machine."""
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["tests.training.rank_process", "glassplat.cli.train", "torch.distributed"])


def stages_of(name: str) -> tuple[Stage, ...]:
    """Stages in which every kind of edit occurs within a few steps."""
    if name == "planar":
        return planar_stages()
    return RECIPES["splat"](sh_degree=1, strategy="mcmc").stages(seed=0)


def trained(name: str, ranks: Ranks, iterations: int) -> tuple[TrainState, list[Message]]:
    """The state after the given number of iterations, and all messages."""
    state = TrainState(RECIPES["splat"](sh_degree=1).initialise(tiny_capture()), seed=0)
    messages = train(stages_of(name), tiny_capture(), state, iterations, ranks=ranks)
    return state, list(messages)


def losses_of(messages: list[Message]) -> list[float]:
    """The loss of every step."""
    return [message.loss for message in messages if isinstance(message, StepDone)]


def forked(target: Callable[..., None], *arguments: Any) -> BaseProcess:
    """A function in a process that has imported everything, computes on one thread, and ends with the tests."""
    process = FORKS.Process(target=target, args=arguments, daemon=True)
    with pytest.MonkeyPatch.context() as patch:
        # The parent of all forked processes reads them once.
        patch.setenv("NUMBA_NUM_THREADS", "1")
        patch.setenv("OMP_NUM_THREADS", "1")
        process.start()
    return process


class ForkedRank:
    """`python -m ARGUMENTS` in a forked process, with the interface of `Popen`; its output goes to files."""

    def __init__(
        self, arguments: list[str], environment: dict[str, str], said: Path, shorter: dict[str, Any] | None = None
    ) -> None:
        self.args, self._said = arguments, said
        self._process = forked(_become, arguments, environment, said, shorter or {})
        self.pid, self.kill, self.terminate = self._process.pid, self._process.kill, self._process.terminate

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def communicate(self, timeout: float) -> tuple[str, str]:
        """Its standard output and standard error, once it has ended."""
        self._process.join(timeout)
        assert self.returncode is not None, f"{self.args} does not end"
        return self._said.with_suffix(".out").read_text(), self._said.with_suffix(".err").read_text()


def _become(arguments: list[str], environment: dict[str, str], said: Path, shorter: dict[str, Any]) -> None:
    os.environ.update(environment)
    os.chdir(ROOT)
    vars(ranks).update(shorter)
    for number, suffix in ((1, ".out"), (2, ".err")):
        with said.with_suffix(suffix).open("wb") as file:
            os.dup2(file.fileno(), number)
    sys.argv = arguments
    runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)


def start_apart(
    arguments: list[str],
    folder: Path,
    *,
    count: int = 2,
    of_rank_1: Sequence[str] = (),
    shorter: dict[str, Any] | None = None,
) -> list[ForkedRank]:
    """Starts ranks as separate machines would, the second one with further arguments.

    Args:
        arguments: a module and its arguments.
        folder: receives their output.
        count: number of ranks.
        of_rank_1: further arguments of the second rank.
        shorter: waiting times that replace those of `glassplat.training.ranks`.
    """
    with socket.socket() as found:
        found.bind(("localhost", 0))
        port = str(found.getsockname()[1])
    where = {"MASTER_ADDR": "localhost", "MASTER_PORT": port, "TORCHELASTIC_RUN_ID": "test", "WORLD_SIZE": str(count)}
    return [
        ForkedRank(
            [*arguments, *(of_rank_1 if rank == 1 else ())],
            where | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            folder / f"said_by_{rank}",
            shorter,
        )
        for rank in range(count)
    ]


@contextmanager
def torchrun(count: int, arguments: list[str], folder: Path) -> Iterator[ForkedRank]:
    """`torchrun` with `python -m ARGUMENTS` in `count` processes, terminated on leaving the context.

    Args:
        count: number of ranks.
        arguments: a module and its arguments.
        folder: receives their output.
    """
    options = ["--standalone", f"--nproc-per-node={count}", "-m"]
    process = ForkedRank(["torch.distributed.run", *options, *arguments], {}, folder / "said_by_torchrun")
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=LONGEST)


def main() -> None:
    """Trains as one of the ranks, once per `NAME:ITERATIONS`, as starting a process takes longer than a training."""
    *trainings, root = sys.argv[1:]
    ranks = join_ranks()
    for training in trainings:
        name, iterations = training.split(":")
        state, messages = trained(name, ranks, int(iterations))
        folder = Path(root) / f"{name}_{iterations}"
        folder.mkdir(exist_ok=True)
        save_checkpoint(folder / f"{ranks.rank}.safetensors", state)
        (folder / f"{ranks.rank}.json").write_text(json.dumps(losses_of(messages)))


if __name__ == "__main__":
    main()
