"""Several ranks train like a single one that accumulates their views, and end together."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from functools import cache
from pathlib import Path

import pytest
import torch

from glassplat.cli.main import main
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.training.actions import PruneIdle
from glassplat.training.checkpoint import load_checkpoint
from glassplat.training.messages import ActionDone, Message, StepDone, Working
from glassplat.training.ranks import COLLECTIVE_TIMEOUT, RankReport, Ranks
from glassplat.training.stage import Clock, Optimizer, TrainState
from tests.training.rank_process import (
    LONGEST,
    ForkedRank,
    losses_of,
    stages_of,
    start_apart,
    torchrun,
    trained,
)
from tests.training.tiny_capture import tiny_capture, write_tiny_capture

ITERATIONS = 40


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_capture(tmp_path_factory.mktemp("capture") / "tiny")


def train_arguments(capture: Path, output: Path, *more: str, iterations: int = ITERATIONS) -> list[str]:
    common = ["--data", str(capture), "--output", str(output), "--device", "cpu", "--iterations", str(iterations)]
    return ["glassplat", "train", "splat", *common, *more]


def ranks_of(process: ForkedRank) -> list[int]:
    """The processes started by `torchrun`, in the order of their ranks."""
    found = {}
    for number in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
        for entry in Path(f"/proc/{number}/environ").read_bytes().split(b"\0"):
            if entry.startswith(b"RANK="):
                found[int(entry.removeprefix(b"RANK="))] = int(number)
    return [found[rank] for rank in sorted(found)]


def wait_for(path: Path, process: ForkedRank) -> None:
    """Waits until a file exists."""
    end = time.monotonic() + LONGEST
    while not path.is_file():
        assert process.poll() is None, ended(process)
        assert time.monotonic() < end, f"{path} never came"
        time.sleep(0.05)


def ended(process: ForkedRank) -> str:
    """The output of a process until it ends."""
    return "".join(process.communicate(timeout=LONGEST))


def started_apart(arguments: list[str], folder: Path, of_rank_1: list[str]) -> list[subprocess.CompletedProcess[str]]:
    """Two ranks started as on two machines, the second one with further arguments; returned once both have ended."""
    processes = start_apart(arguments, folder, of_rank_1=of_rank_1)
    spoken = [process.communicate(timeout=LONGEST) for process in processes]
    return [subprocess.CompletedProcess(p.args, p.returncode, *said) for p, said in zip(processes, spoken, strict=True)]


def said(done: subprocess.CompletedProcess[str]) -> list[str]:
    """Lines of glassplat on standard error; `torchrun` adds its own."""
    return [line for line in done.stderr.splitlines() if line.startswith(("error:", "stopped:", "usage:"))]


@pytest.fixture(scope="module")
def trained_by(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Path]:
    """A function that returns the folder of the results of a number of ranks, with a subfolder for each training."""

    @cache
    def folder_of(count: int) -> Path:
        folder = tmp_path_factory.mktemp(f"{count}_ranks")
        trainings = [f"planar:{ITERATIONS}", f"planar:{count}", *([f"mcmc:{ITERATIONS}"] if count == 2 else [])]
        arguments = ["tests.training.rank_process", *trainings, str(folder)]
        for rank in start_apart(arguments, folder, count=count):
            _, complaint = rank.communicate(timeout=LONGEST)
            assert rank.returncode == 0, complaint
        return folder

    return folder_of


@pytest.mark.parametrize(("name", "count"), [("planar", 2), ("planar", 3), ("mcmc", 2)])
def test_ranks_agree_with_one_process_that_accumulates_their_views(
    name: str, count: int, trained_by: Callable[[int], Path]
) -> None:
    folder = trained_by(count) / f"{name}_{ITERATIONS}"
    first, *others = (load_checkpoint(folder / f"{rank}.safetensors") for rank in range(count))
    alone, messages = trained(name, Ranks(batch=count), ITERATIONS)
    assert any(isinstance(message, ActionDone) for message in messages)
    assert first.step == alone.step == ITERATIONS
    losses = [json.loads((folder / f"{rank}.json").read_text()) for rank in range(count)]
    assert losses[0] == pytest.approx(losses_of(messages), rel=2e-3)
    assert all(of_rank == losses[0] for of_rank in losses)
    for tensor_name, expected in alone.scene.parameters().items():
        found = first.scene.parameters()[tensor_name]
        assert found.shape == expected.shape, tensor_name
        assert all(torch.equal(other.scene.parameters()[tensor_name], found) for other in others), tensor_name
    for part, statistics in alone.statistics.items():
        # Views in panes are weighted by rendered values, and Adam takes full steps even where gradients are rounding.
        assert torch.allclose(first.statistics[part].view_count, statistics.view_count, rtol=1e-3), part
        assert torch.allclose(first.statistics[part].gradient_sum, statistics.gradient_sum, rtol=1e-2), part


@pytest.mark.parametrize("count", [2, 3])
def test_gradients_of_ranks_are_the_means_over_their_views(count: int, trained_by: Callable[[int], Path]) -> None:
    """Moments are linear in the gradients, whereas Adam takes a full step even where a gradient is only rounding."""
    found = load_checkpoint(trained_by(count) / f"planar_{count}" / "0.safetensors").optimizer
    expected = trained("planar", Ranks(batch=count), count)[0].optimizer
    assert found.updates == expected.updates
    for name, (first, _) in expected.moments.items():
        assert float((found.moments[name][0] - first).norm()) <= 1e-5 * float(first.norm()) + 1e-9, name


@pytest.mark.parametrize("count", [2, 3, 4])
def test_a_pass_shows_every_view_once_and_a_stage_ends_where_it_would_alone(count: int) -> None:
    state, messages = trained("planar", Ranks(batch=count), 30)
    steps = [message for message in messages if isinstance(message, StepDone)]
    names = [name for step in steps for name in step.view.split(", ")]
    assert len(names) == state.step == 30
    for begin in range(0, 30, 6):
        assert set(Counter(names[begin : begin + 6]).values()) == {1}
    assert {6, 15, 30} <= {step.step for step in steps}  # The stages have shares of 0.2, 0.3 and 0.5.


@pytest.mark.parametrize("count", [2, 3, 7])
def test_no_action_is_missed_where_steps_go_over_its_moment(count: int) -> None:
    """The result of a search may depend on the batch; the search itself must take place."""
    alone, together = (Counter(actions_taken(trained("planar", Ranks(batch=batch), 60)[1])) for batch in (1, count))
    assert together == alone
    assert alone["searching for unnecessary Gaussians"] == 3 and alone["grow SH"] == 1


def test_a_test_times_out_before_a_rank() -> None:
    assert timedelta(seconds=LONGEST) < COLLECTIVE_TIMEOUT


def test_ranks_compare_whatever_an_action_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Comparing needs all ranks, and where rounding differs, one rank may find something that another does not."""
    settled: list[int] = []
    monkeypatch.setattr(Ranks, "synchronise", lambda self, state: settled.append(state.step))
    trained("splat", Ranks(), 60)
    usually = settled.copy()
    settled.clear()
    monkeypatch.setattr(PruneIdle, "apply", lambda *_: False)
    trained("splat", Ranks(), 60)
    assert settled == usually and len(usually) > 3


def actions_taken(messages: Sequence[Message]) -> Iterator[str]:
    """Message of each action that starts a search, and each increase of the SH degree, which always succeeds."""
    for message in messages:
        if isinstance(message, Working) and message.done == 0:
            yield message.what
        elif isinstance(message, ActionDone) and message.action == "grow SH":
            yield message.action


def test_ranks_end_once_torchrun_has(monkeypatch: pytest.MonkeyPatch) -> None:
    ranks = Ranks(0, 2)
    monkeypatch.setattr(ranks, "_gather", lambda report: [report, RankReport()])
    ranks.exchange()
    assert not ranks.is_ending
    monkeypatch.setattr(os, "getppid", lambda: 1)  # As of an orphan.
    ranks.exchange()
    assert ranks.is_ending


def test_learning_rates_grow_by_the_root_of_the_views_and_pauses_count_views() -> None:
    moved = []
    for views in (1, 4):
        parameters, optimizer = {"a": torch.zeros(3)}, Optimizer(paused={"b": 5})
        optimizer.step(parameters, {"a": torch.ones(3)}, {"a": 0.1}, batch=views)
        moved.append(parameters["a"])
        optimizer.step({"b": torch.zeros(1)}, {"b": torch.ones(1)}, {"b": 0.1}, batch=views)
        assert optimizer.paused["b"] == 5 - views
    assert torch.allclose(moved[1], 2 * moved[0])


def test_moments_remember_as_many_views_whatever_the_batch() -> None:
    """Four views with the same gradient, then none: together, one by one, or with a rank count that varies."""
    moments = []
    for batches in ((1, 1, 1, 1, 1, 1), (4, 2), (2, 1, 1, 2)):
        parameters, optimizer = {"a": torch.zeros(3, dtype=torch.float64)}, Optimizer()
        views = 0
        for count in batches:
            gradient = torch.full((3,), float(views < 4), dtype=torch.float64)
            optimizer.step(parameters, {"a": gradient}, {"a": 0.1}, batch=count)
            views += count
        assert optimizer.updates == {"a": 6}
        moments.append(optimizer.moments["a"])
    for first, second in moments[1:]:
        assert torch.allclose(first, moments[0][0])
        assert torch.allclose(second, moments[0][1])


def test_noise_grows_as_the_rate_that_it_follows() -> None:
    *_, explore, _ = stages_of("mcmc")[0].post_steps
    moved = []
    for batch in (1, 4):
        state = TrainState(SplatRecipe(sh_degree=1).initialise(tiny_capture()), seed=0)
        before = state.scene.primary.means.clone()
        explore(state, Clock(10, 100, 6, batch=batch), None)
        moved.append(state.scene.primary.means - before)
    assert torch.allclose(moved[1], 2 * moved[0], rtol=1e-2, atol=1e-6)


def test_one_process_of_torchrun_learns_the_same_bits_as_without(capture: Path, tmp_path: Path) -> None:
    with torchrun(1, train_arguments(capture, tmp_path / "torchrun"), tmp_path) as process:
        text = ended(process)
    assert process.returncode == 0, text
    assert main(train_arguments(capture, tmp_path / "plain")[1:]) == 0
    files = [tmp_path / run / f"point_cloud/iteration_{ITERATIONS}/point_cloud.ply" for run in ("torchrun", "plain")]
    assert files[0].read_bytes() == files[1].read_bytes()


def test_an_interrupted_run_resumes_with_another_number_of_ranks(capture: Path, tmp_path: Path) -> None:
    arguments = train_arguments(capture, tmp_path / "run", "--checkpoint-every", "0.01", iterations=100_000)
    checkpoint = tmp_path / "run" / "checkpoint.safetensors"
    with torchrun(2, arguments, tmp_path) as process:
        wait_for(checkpoint, process)
        os.kill(ranks_of(process)[1], signal.SIGTERM)
        assert "repeat the command with --resume" in ended(process)
    begun = load_checkpoint(checkpoint).step
    first, asked, last = start_apart([*arguments, "--resume"], tmp_path, count=3)
    try:
        while load_checkpoint(checkpoint).step <= begun:
            assert first.poll() is None, ended(first)
            time.sleep(0.05)
        asked.send_signal(signal.SIGTERM)
        assert "repeat the command with --resume" in ended(first)
    finally:
        for rank in (first, asked, last):
            rank.kill()
    assert begun > 0 and begun % 2 == 0
    assert (load_checkpoint(checkpoint).step - begun) % 3 == 0


@pytest.fixture(scope="module")
def waiting(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[ForkedRank, Path]]:
    """The leader that waits 15 seconds for a silent rank, and its output; other tests run in the meantime."""
    output = tmp_path_factory.mktemp("waiting") / "run"
    with silent_rank(capture, output, COLLECTIVE_TIMEOUT=timedelta(seconds=15)) as first:
        yield first, output


@pytest.mark.usefixtures("waiting")
@pytest.mark.parametrize("rank", [0, 1])
def test_the_death_of_a_rank_ends_the_others_with_one_message(rank: int, capture: Path, tmp_path: Path) -> None:
    arguments = train_arguments(capture, tmp_path / "run", "--checkpoint-every", "0.01", iterations=100_000)
    with torchrun(2, arguments, tmp_path) as process:
        wait_for(tmp_path / "run" / "checkpoint.safetensors", process)
        os.kill(ranks_of(process)[rank], signal.SIGKILL)
        text = ended(process)  # `torchrun` waits less long for it than a rank waits for a silent one.
    assert process.returncode == 1
    ours = [line for line in text.splitlines() if line.startswith(("stopped:", "error:"))]
    assert len(ours) == (0 if rank == 0 else 1), text  # The end of rank 0 is reported by `torchrun`.
    assert load_checkpoint(tmp_path / "run" / "checkpoint.safetensors").step > 0


@contextmanager
def silent_rank(capture: Path, output: Path, **shorter: object) -> Iterator[ForkedRank]:
    """The leader of two ranks that have saved a checkpoint, the other one of which has been stopped."""
    arguments = train_arguments(capture, output, "--checkpoint-every", "0.01", iterations=100_000)
    first, silent = start_apart(arguments, output.parent, shorter=shorter)
    try:
        wait_for(output / "checkpoint.safetensors", first)
        silent.send_signal(signal.SIGSTOP)
        yield first
    finally:
        first.kill()
        silent.kill()


def last_word(first: ForkedRank, output: Path) -> str:
    """The leader's message about a stopped rank; it saves and exits with 1."""
    _, text = first.communicate(timeout=LONGEST)
    assert first.returncode == 1
    ours = [line for line in text.splitlines() if line.startswith(("stopped:", "error:"))]
    assert len(ours) == 1, text
    assert load_checkpoint(output / "checkpoint.safetensors").step > 0
    return ours[0]


def test_a_terminated_rank_waits_briefly_for_the_others(capture: Path, tmp_path: Path) -> None:
    with silent_rank(capture, tmp_path / "run", TERMINATION_TIMEOUT=3.0) as first:
        time.sleep(1.0)
        first.send_signal(signal.SIGTERM)
        assert "asked to stop" in last_word(first, tmp_path / "run")


def test_training_is_saved_when_a_rank_stops_responding(waiting: tuple[ForkedRank, Path]) -> None:
    assert "does not respond" in last_word(*waiting)


@pytest.mark.parametrize(
    ("of_rank_1", "expected"),
    [
        (["--seed", "1"], "error: rank 1 has 1 as seed, rank 0 has 0"),
        (["--sh-degree", "2"], "error: rank 1 has 2 as sh_degree, rank 0 has 3"),
        (["--data", "/nowhere"], "error: rank 1: "),
        (["--downscale", "0.5"], "error: rank 1: "),
        (["--no-such-option"], "error: rank 1: glassplat train splat has no option --no-such-option"),
    ],
)
def test_ranks_that_disagree_end_with_one_message_of_rank_0(
    of_rank_1: list[str], expected: str, capture: Path, tmp_path: Path
) -> None:
    done = started_apart(train_arguments(capture, tmp_path / "run"), tmp_path, of_rank_1)
    assert [process.returncode for process in done] == [2, 2]
    assert expected in done[0].stderr
    assert len(said(done[0])) == 1
    assert done[1].stderr == done[1].stdout == ""
    assert not (tmp_path / "run").exists()


def test_an_output_error_of_rank_0_ends_all_ranks(capture: Path, tmp_path: Path) -> None:
    (tmp_path / "run").write_text("in the way")
    done = started_apart(train_arguments(capture, tmp_path / "run"), tmp_path, [])
    assert [process.returncode for process in done] == [2, 2]
    assert len(said(done[0])) == 1
    assert done[1].stderr == ""
