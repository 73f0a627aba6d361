"""Broken photographs are found while training starts, whichever part they belong to."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from threading import Event

import pytest
import torch

from glassplat.captures.dataset import Dataset, load_dataset, read_photographs_in_background
from glassplat.errors import InputError

PATIENCE = 60
"""Seconds after which a test gives up."""


def wait_for(check: Callable[[], None], done: Callable[[], bool]) -> None:
    """Repeats a check until something has happened; an error of the check ends it too."""
    for _ in range(PATIENCE * 100):
        check()
        if done():
            return
        time.sleep(0.01)
    raise TimeoutError("nothing happened")


@pytest.mark.parametrize("part", ["train", "test"])
def test_a_truncated_photograph_is_found(capture, part: str) -> None:
    capture.write_colmap()
    data = load_dataset(capture.root)
    view = getattr(data, part)[-1]
    os.truncate(view.image_path, view.image_path.stat().st_size // 2)
    with pytest.raises(InputError, match=view.name), read_photographs_in_background(data) as check:
        wait_for(check, lambda: False)


def counting(data: Dataset) -> tuple[Dataset, dict[str, int]]:
    """The data set with views that count their reads."""
    times: dict[str, int] = {}

    def counted(view):
        def read() -> torch.Tensor:
            times[view.name] = times.get(view.name, 0) + 1
            return view.read_photo()

        return replace(view, read_photo=read)

    return replace(data, train=tuple(map(counted, data.train)), test=tuple(map(counted, data.test))), times


def test_every_photograph_is_read_once_and_those_for_training_stay(capture) -> None:
    capture.write_colmap()
    data, times = counting(load_dataset(capture.root))
    with read_photographs_in_background(data) as check:
        wait_for(check, lambda: len(times) == len(data.train) + len(data.test))
    before = dict(times)
    assert list(times)[: len(data.test)] == [view.name for view in data.test]
    for view in data.train:
        assert view.photo is view.photo
    assert times == before == dict.fromkeys(times, 1)


def test_reading_ends_with_the_context(capture, monkeypatch: pytest.MonkeyPatch) -> None:
    capture.write_colmap()
    data, times = counting(load_dataset(capture.root))
    begun, stop = Event(), Event()

    def slow() -> torch.Tensor:
        begun.set()
        assert stop.wait(PATIENCE)
        return torch.zeros(24, 32, 3, dtype=torch.uint8)

    monkeypatch.setattr("glassplat.captures.dataset.Event", lambda: stop)
    with read_photographs_in_background(replace(data, test=(replace(data.test[0], read_photo=slow), *data.test[1:]))):
        assert begun.wait(PATIENCE)
    assert times == {}
