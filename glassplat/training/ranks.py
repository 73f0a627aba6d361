"""Training with several processes, started by `torchrun` on one or several machines.

Every process, a rank, holds the whole scene and renders one view of each step. Gradients, statistics and visible sets
are reduced over ranks, so that all ranks take the same steps and make the same edits. Rank 0, the leader, writes files
and reports progress and errors; the others are silent.

Tensors on GPUs are communicated by NCCL, everything else by Gloo. Every collective operation starts with an
`exchange`, in which a failed rank reports its failure, so that the others do not wait for it.
"""

from __future__ import annotations

import os
import signal
import sys
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from glassplat.errors import InputError, RankLostError

if TYPE_CHECKING:
    from torch import Tensor

    from glassplat.training.stage import TrainState

COLLECTIVE_TIMEOUT = timedelta(minutes=10)
"""Timeout for a live rank: it may save a large scene, compile kernels, or be paused in the viewer. Dead ranks are
noticed at once."""
TERMINATION_TIMEOUT = 15.0
"""Seconds for which a terminated process waits for the others: it has to save before `torchrun` kills it after 30."""
LOST_MESSAGE = (
    "another process of the run has ended unexpectedly, or its machine does not respond ({}); repeat the command with "
    "--resume to continue from the last checkpoint"
)
LONGEST_QUOTE = 150
"""Maximum length of an error message that is quoted, in characters."""


def is_launched() -> bool:
    """Return whether `torchrun` started this process as one of several."""
    return "TORCHELASTIC_RUN_ID" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1


def is_leader() -> bool:
    """Return whether this process writes and reports: it is the only one, or rank 0."""
    return not is_launched() or os.environ.get("RANK", "0") == "0"


class RankReport(NamedTuple):
    """Contribution of a rank to an exchange: its value, whether it was asked to end, or its failure."""

    value: Any = None
    is_stop_requested: bool = False
    failure: tuple[str, str, int] | None = None


class Ranks:
    """The processes of a run, from the point of view of one of them.

    Attributes:
        rank: number of this process.
        count: number of processes.
        batch: views per step, of which rank r renders r, r + count, ...; by default one per rank.
        is_stop_requested: returns whether this process was asked to end.
    """

    def __init__(self, rank: int = 0, count: int = 1, batch: int | None = None) -> None:
        self.rank, self.count = rank, count
        self.batch = count if batch is None else batch
        self.is_stop_requested: Callable[[], bool] = lambda: False
        self._is_ending = False
        self._parent = os.getppid()
        self._thread = ThreadPoolExecutor(1)

    @property
    def is_leader(self) -> bool:
        """Return whether this is the process that writes."""
        return self.rank == 0

    @property
    def is_ending(self) -> bool:
        """Return whether any process was asked to end; the same on all ranks after an exchange."""
        return self.is_stop_requested() if self.count == 1 else self._is_ending

    def _is_asked_to_end(self) -> bool:
        """Return whether this process was asked to end, or `torchrun`, its parent, has ended without asking it."""
        return self.is_stop_requested() or os.getppid() != self._parent

    def exchange(self, value: Any = None) -> list[Any]:
        """The values of all ranks, in their order.

        Raises:
            RankLostError: one has failed, or ended unexpectedly.
        """
        if self.count == 1:
            return [value]
        reports = self._gather(RankReport(value, self._is_asked_to_end()))
        failed = next((rank for rank, one in enumerate(reports) if one.failure is not None), None)
        if failed is not None:
            _block_termination()
            label, text, code = reports[failed].failure
            raise RankLostError(f"rank {failed}: {text}", (label, f"rank {failed}: {text}", code))
        self._is_ending = any(one.is_stop_requested for one in reports)
        return [one.value for one in reports]

    def _gather(self, report: RankReport) -> list[Any]:
        import torch.distributed as dist

        reports: list[Any] = [None] * self.count
        with _rank_lost_errors():
            self._wait_for(lambda: dist.all_gather_object(reports, report))
        return reports

    def _wait_for(self, call: Callable[[], object]) -> None:
        """Runs a collective call in a thread, because Python handles no signals inside of it.

        Raises:
            RuntimeError: this process was asked to end, and the others did not respond within `TERMINATION_TIMEOUT`.
        """
        requested_at = None
        future = self._thread.submit(call)
        while not wait([future], TERMINATION_TIMEOUT / 10).done:
            if requested_at is None and self._is_asked_to_end():
                requested_at = time.monotonic()
            if requested_at is not None and time.monotonic() - requested_at > TERMINATION_TIMEOUT:
                raise RuntimeError("no answer since this process was asked to stop")
        future.result()

    def reduce(self, operation: Literal["SUM", "MAX"], tensors: Sequence[Tensor]) -> list[Tensor]:
        """Sums or maxima over all ranks of tensors of one type and device; to be called after an exchange."""
        if self.count == 1 or not tensors:
            return list(tensors)
        import torch
        import torch.distributed as dist

        # One message instead of dozens, each with its own latency.
        flat = torch.cat([tensor.detach().reshape(-1) for tensor in tensors])
        with _rank_lost_errors():
            reduce = partial(dist.all_reduce, flat, getattr(dist.ReduceOp, operation))
            reduce() if flat.is_cuda else self._wait_for(reduce)
        parts = flat.split([tensor.numel() for tensor in tensors])
        return [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]

    def broadcast(self, state: TrainState | None, device: str) -> TrainState:
        """The leader's state on this rank's device; other ranks need no state."""
        if self.count > 1:
            import torch.distributed as dist

            self.exchange()
            sent = [state.to("cpu") if self.is_leader and state is not None else None]
            with _rank_lost_errors():
                dist.broadcast_object_list(sent, src=0)
            if not self.is_leader and sent[0] is not None:
                state = sent[0].to(device)
        assert state is not None
        return state

    def synchronise(self, state: TrainState) -> None:
        """Ensures that all ranks have bit-identical states after an edit, if necessary by copying the leader's.

        All draw the same random numbers, but different machines round differently, and some GPU sums are not
        deterministic.
        """
        if self.count > 1 and len(set(self.exchange(state_checksum(state)))) > 1:
            vars(state).update(vars(self.broadcast(state, str(state.scene.primary.means.device))))

    def check_equal(self, settings: Mapping[str, object]) -> None:
        """Refuses ranks that were started with different settings.

        Args:
            settings: values that have to agree, by name.

        Raises:
            InputError: a value differs; the message names it and the rank.
        """
        first, *others = self.exchange(dict(settings))
        for rank, other in enumerate(others, 1):
            for name in first.keys() | other.keys():
                if first.get(name) != other.get(name):
                    raise InputError(
                        f"rank {rank} has {other.get(name)} as {name}, rank 0 has {first.get(name)}; expected the same "
                        "version, capture and options on every machine"
                    )


def state_checksum(state: TrainState) -> int:
    """A checksum of all parameters, moments and records."""
    import torch

    tensors = state.scene.parameters() | {f"mean {name}": mean for name, mean in state.means.items()}
    for name, (first, second) in state.optimizer.moments.items():
        tensors |= {f"first {name}": first, f"second {name}": second}
    ints = {2: torch.int16, 4: torch.int32, 8: torch.int64}
    sums = {
        name: (tuple(t.shape), int(t.detach().contiguous().view(ints[t.element_size()]).sum(dtype=torch.int64)))
        for name, t in tensors.items()
    }
    optimizer = state.optimizer
    return zlib.crc32(repr((sums, state.records, optimizer.paused, optimizer.raised_rates, optimizer.updates)).encode())


def join_ranks() -> Ranks:
    """The processes started by `torchrun`; only this one without it.

    Each uses the GPU of its local rank, or on the CPU as many threads as PyTorch.

    Raises:
        RankLostError: the others cannot be reached.
    """
    if not is_launched():
        return Ranks()
    import torch
    import torch.distributed as dist

    if not dist.is_initialized():
        _select_gpu()
        _set_numba_threads()
        with _rank_lost_errors():
            has_nccl = torch.cuda.is_available() and dist.is_nccl_available()
            backend = "cpu:gloo,cuda:nccl" if has_nccl else "gloo"
            dist.init_process_group(backend, timeout=COLLECTIVE_TIMEOUT)
    return Ranks(dist.get_rank(), dist.get_world_size())


def report_failure(label: str, text: str, code: int) -> None:
    """Reports a failure to the other ranks in the next exchange; waits until the leader has ended.

    It does nothing in a single process. The leader returns at once.
    """
    if not is_launched():
        return
    with suppress(RankLostError):
        ranks = join_ranks()
        ranks._gather(RankReport(failure=(label, text, code)))
    await_leader()


def await_leader() -> None:
    """Waits until the leader has ended, because `torchrun` soon kills all ranks after the first one ends."""
    if is_leader():
        return
    with suppress(RankLostError):
        ranks = join_ranks()
        while True:
            ranks._gather(RankReport())


def exit_at_once(code: int) -> None:
    """Ends the process immediately if it is one of several or was interrupted; else does nothing.

    Python's cleanup is skipped: COLMAP aborts in it after a second Ctrl-C, if one of its threads is still at work, and
    PyTorch sometimes aborts when connections close while another rank still communicates.
    """
    was_interrupted = code > 128  # As shells report signals.
    if was_interrupted or (is_launched() and "torch.distributed" in sys.modules):
        with suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


@contextmanager
def _rank_lost_errors() -> Iterator[None]:
    """Turns PyTorch's error about a lost rank into a RankLostError."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        if isinstance(error, RankLostError | InputError):
            raise
        _block_termination()
        raise RankLostError(LOST_MESSAGE.format(str(error).partition("\n")[0][:LONGEST_QUOTE])) from error


def _block_termination() -> None:
    """Lets the process save and report before it ends: `torchrun` waits 30 seconds after SIGTERM."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})


def _set_numba_threads() -> None:
    """Gives Numba as many threads as PyTorch, because `torchrun` sets only OpenMP's."""
    import numba
    import torch

    if "NUMBA_NUM_THREADS" not in os.environ:
        numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))


def _select_gpu() -> None:
    """Makes only the GPU of this rank visible; to be called before CUDA is initialised."""
    number = int(os.environ.get("LOCAL_RANK", "0"))
    known = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = known.split(",") if known else None
    os.environ["CUDA_VISIBLE_DEVICES"] = str(number) if names is None else ",".join(names[number : number + 1])
