"""One of several processes that train the tiny capture together; `torchrun` starts it, and it writes what it has."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from glassplat.methods.recipe import RECIPES
from glassplat.training.checkpoint import save_checkpoint
from glassplat.training.loop import train
from glassplat.training.messages import Message, StepDone
from glassplat.training.ranks import Ranks, join
from glassplat.training.stage import Stage, TrainState
from tests.training.test_trainer import planar_stages
from tests.training.tiny_capture import tiny_capture

ROOT = Path(__file__).parents[2]
ONE_THREAD = os.environ | {"NUMBA_NUM_THREADS": "1"}


def stages_of(name: str) -> tuple[Stage, ...]:
    """Stages in which every kind of edit comes up within a few steps."""
    if name == "planar":
        return planar_stages()
    return RECIPES["splat"](sh_degree=1, strategy="mcmc").stages(seed=0)


def trained(name: str, ranks: Ranks, iterations: int) -> tuple[TrainState, list[Message]]:
    """The state after so many iterations, and what happened."""
    state = TrainState(RECIPES["splat"](sh_degree=1).initialise(tiny_capture()), seed=0)
    messages = train(stages_of(name), tiny_capture(), state, iterations, ranks=ranks)
    return state, list(messages)


def losses_of(messages: list[Message]) -> list[float]:
    """The loss of every step."""
    return [message.loss for message in messages if isinstance(message, StepDone)]


def torchrun(count: int, *arguments: str, timeout: float = 240) -> subprocess.CompletedProcess[str]:
    """Runs `python -m ARGUMENTS` in so many processes."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}", "-m"]
    return subprocess.run(
        [*command, *arguments], cwd=ROOT, env=ONE_THREAD, capture_output=True, text=True, timeout=timeout, check=False
    )


def main() -> None:
    """Trains as one of the ranks, once for each `NAME:ITERATIONS`: processes that start take longer than this."""
    *trainings, root = sys.argv[1:]
    ranks = join()
    for training in trainings:
        name, iterations = training.split(":")
        state, messages = trained(name, ranks, int(iterations))
        folder = Path(root) / f"{name}_{iterations}"
        folder.mkdir(exist_ok=True)
        save_checkpoint(folder / f"{ranks.rank}.safetensors", state)
        (folder / f"{ranks.rank}.json").write_text(json.dumps(losses_of(messages)))


if __name__ == "__main__":
    main()
