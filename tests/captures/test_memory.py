"""Photographs stay in memory up to a budget, and beyond it are read ahead of their step."""

from __future__ import annotations

import io
import math
import os
import pickle
from collections import Counter
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import pytest
import torch

from glassplat.captures import view as view_module
from glassplat.captures.dataset import load_dataset
from glassplat.captures.view import MOST_AHEAD, PixelCache, default_budget, machine_memory
from glassplat.errors import InputError
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.scene.scene import Scene
from glassplat.training.loop import train
from glassplat.training.messages import StepDone
from glassplat.training.stage import TrainState

SIZE = 100
"""Pixels of the test's photographs, of three bytes each."""
WHOLE = 3 * SIZE


@pytest.fixture(autouse=True)
def room_on_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """The few bytes of the tests also fit on a disk that is nearly full."""
    monkeypatch.setattr(view_module, "DISK_RESERVE", 0)


class Files:
    """Readers of numbered photographs that count the reads of each."""

    def __init__(self, count: int) -> None:
        self.times: Counter[int] = Counter()
        self.readers = [self._reader(number) for number in range(count)]

    def _reader(self, number: int):
        def read() -> torch.Tensor:
            self.times[number] += 1
            return torch.full((SIZE, 3), number, dtype=torch.uint8)

        return read


def test_photographs_that_fit_in_memory_are_read_once() -> None:
    files, memory = Files(10), PixelCache(math.inf, largest=SIZE)
    for _ in range(3):
        assert [int(memory.get(reader)[0, 0]) for reader in files.readers] == list(range(10))
    assert set(files.times.values()) == {1}
    assert not memory.is_full


def test_part_of_the_photographs_stays_cached_within_the_memory_limit() -> None:
    files, memory = Files(100), PixelCache(60 * WHOLE, largest=SIZE)
    for _ in range(3):
        for reader in files.readers:
            memory.get(reader)
        held = [*memory._resident.values(), *memory._transient.values()]
        assert sum(tensor.numel() for tensor in held) <= memory.budget
    assert memory.is_full
    assert sum(times == 1 for times in files.times.values()) >= 40


def test_a_step_reads_its_photograph_even_beyond_the_memory_limit() -> None:
    files, memory = Files(4), PixelCache(1, largest=SIZE)
    assert [int(memory.get(reader)[0, 0]) for reader in files.readers] == [0, 1, 2, 3]
    assert memory.get(files.readers[3]) is memory.get(files.readers[3])
    assert len(memory._transient) <= 3
    assert memory.ahead == 1
    assert PixelCache(math.inf).ahead == MOST_AHEAD


def numbers(memory: PixelCache, files: Files) -> list[int]:
    return [int(memory.get(reader)[0, 0]) for reader in files.readers]


class Failing(io.BytesIO):
    """A file on a disk that has failed."""

    def readinto(self, buffer) -> int:
        raise OSError("input/output error")

    def write(self, data) -> int:
        raise OSError("no space left on device")


@pytest.fixture
def slow_files(monkeypatch: pytest.MonkeyPatch) -> Files:
    """Files that take longer to read than copies on a disk, and more of them than `PixelCache(1)` holds."""
    monkeypatch.setattr(view_module, "DISK_RATE", math.inf)
    return Files(20)


def test_slow_photographs_beyond_the_budget_are_cached_on_disk(slow_files: Files, tmp_path: Path) -> None:
    memory = PixelCache(1, largest=SIZE)
    with memory.cache_on_disk(tmp_path):
        for _ in range(3):
            assert numbers(memory, slow_files) == list(range(20))
        assert not list(tmp_path.iterdir()) or os.name == "nt"
    assert set(slow_files.times.values()) == {1}
    assert numbers(memory, slow_files) == list(range(20))
    assert set(slow_files.times.values()) == {2}
    assert not list(tmp_path.iterdir())


def test_masks_come_back_from_disk_as_they_were(slow_files: Files, tmp_path: Path) -> None:
    memory, mask = PixelCache(1, largest=SIZE), lambda: torch.arange(SIZE) % 3 > 0
    with memory.cache_on_disk(tmp_path):
        first = memory.get(mask)
        numbers(memory, slow_files)
        assert torch.equal(memory.get(mask), first)
        assert memory.get(mask).dtype == torch.bool


def test_photographs_that_are_fast_to_read_are_not_cached_on_disk(
    slow_files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_module, "DISK_RATE", 1e-9)
    memory = PixelCache(1, largest=SIZE)
    with memory.cache_on_disk(tmp_path):
        for _ in range(2):
            numbers(memory, slow_files)
    assert set(slow_files.times.values()) == {2}


@pytest.mark.parametrize("what", ["full", "gone", "breaks", "cut off"])
def test_a_failing_disk_cache_changes_no_result(
    what: str, slow_files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory, folder = PixelCache(1, largest=SIZE), tmp_path
    if what == "full":
        monkeypatch.setattr(view_module, "DISK_RESERVE", math.inf)
    if what == "gone":
        folder = tmp_path / "nowhere"
    with memory.cache_on_disk(folder):
        assert numbers(memory, slow_files) == list(range(20))
        if what == "breaks":
            memory._disk_cache._file.close()
            memory._disk_cache._file = Failing()
        if what == "cut off":
            memory._disk_cache._file.truncate(WHOLE // 2)
        assert numbers(memory, slow_files) == list(range(20))
    assert set(slow_files.times.values()) == {2}


def test_a_full_disk_cache_frees_its_space(slow_files: Files, tmp_path: Path) -> None:
    memory = PixelCache(1, largest=SIZE)
    with memory.cache_on_disk(tmp_path):
        numbers(memory, slow_files)
        spool = memory._disk_cache
        assert len(spool._entries) > 10
        spool._file.close()
        spool._file = Failing()
        spool.put(lambda: torch.zeros(SIZE), torch.zeros(SIZE))
        assert spool._file is None and not spool._entries
        assert numbers(memory, slow_files) == list(range(20))


def test_concurrent_requests_share_one_read() -> None:
    files, memory, gate = Files(1), PixelCache(math.inf), Event()

    def slow() -> torch.Tensor:
        gate.wait(30)
        return torch.zeros(1)

    memory.read_ahead(slow)
    asking = Thread(target=lambda: memory.get(slow))
    asking.start()
    gate.set()
    asking.join()
    assert memory.get(slow) is memory.get(slow)
    memory.read_ahead(files.readers[0])
    memory.get(files.readers[0])
    memory.read_ahead(files.readers[0])
    assert files.times == {0: 1}


def test_an_unreadable_file_raises_an_error_at_its_use() -> None:
    def broken() -> torch.Tensor:
        raise InputError("cut off")

    memory = PixelCache(math.inf)
    for _ in range(2):
        memory.read_ahead(broken)
        with pytest.raises(InputError, match="cut off"):
            memory.get(broken)


def test_another_reader_of_a_view_of_the_same_name_is_another_photograph(capture) -> None:
    capture.write_colmap()
    view = load_dataset(capture.root).train[0]
    other = replace(view, read_photo=lambda: torch.zeros_like(view.photo))
    assert view.photo.any()
    assert not other.photo.any()


def test_a_capture_goes_to_another_process_without_the_pixels_that_were_read(capture) -> None:
    capture.write_colmap()
    dataset = load_dataset(capture.root, memory=1.0)
    dataset.train[0].photo.zero_()
    other = pickle.loads(pickle.dumps(dataset))
    assert other.train[0].photo.any()
    assert other.train[1].memory is other.memory
    assert other.memory.budget == dataset.memory.budget
    assert other.memory.ahead == dataset.memory.ahead


def test_the_machine_has_memory_and_processes_share_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert machine_memory() > 1e8
    whole = default_budget()
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert default_budget() == whole / 4


@pytest.mark.parametrize("file", ["memory.max", "memory/memory.limit_in_bytes"])
@pytest.mark.parametrize("group", ["", "slurm/job_7"])
@pytest.mark.parametrize("limited", ["", "slurm"])
def test_memory_limits_of_containers_and_jobs_are_respected(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, file: str, group: str, limited: str
) -> None:
    folder, _, name = file.rpartition("/")
    for number, inner in enumerate(["", "slurm", "slurm/job_7"]):
        (tmp_path / folder / inner).mkdir(parents=True, exist_ok=True)
        limit = "1000000\n" if inner == limited else "max\n" if number else "9223372036854771712\n"
        (tmp_path / folder / inner / name).write_text(limit)
    (tmp_path / "membership").write_text(f"3:cpuset:/other\n4:{folder}:/{group}\n")
    monkeypatch.setattr("glassplat.captures.view.CGROUP_FOLDER", tmp_path)
    monkeypatch.setattr("glassplat.captures.view.CGROUP_FILE", tmp_path / "membership")
    assert (machine_memory() == 1e6) == group.startswith(limited)


def trained_scene(root: Path, memory: float | None, folder: Path) -> Scene:
    dataset = load_dataset(root, memory=memory)
    recipe = SplatRecipe(sh_degree=0)
    state = TrainState(recipe.initialise(dataset), seed=0)
    with dataset.memory.cache_on_disk(folder):
        names = [m.view for m in train(recipe.stages(0), dataset, state, 20) if isinstance(m, StepDone)]
    assert len(names) == 20
    assert dataset.train[0].memory.is_full == (memory is not None)
    return state.scene


def test_a_capture_that_does_not_fit_trains_to_the_same_bits(
    capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_module, "DISK_RATE", math.inf)
    capture.write_colmap()
    roomy, tight = (trained_scene(capture.root, memory, tmp_path) for memory in (None, 1e-6))
    for name, tensor in roomy.parameters().items():
        assert torch.equal(tensor, tight.parameters()[name]), name
