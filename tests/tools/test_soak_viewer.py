"""The soak test of the viewer, for seconds: all clients are served, even after random clicks and cut connections."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.cli.tiny_run import write_run
from tools import soak_viewer
from tools.soak_viewer import Count, Soaked, soak


def test_clients_that_click_at_random_are_served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak_viewer, "SIZES", ((64, 48), (128, 72), (39, 84)))
    said: list[str] = []
    found = asyncio.run(soak(write_run(tmp_path / "run"), clients=7, minutes=0.05, deaf=1, say=said.append))
    assert (found.without_picture, found.complaints, found.count.refused) == (0, [], [])
    assert found.count.connections >= 6 and found.count.actions > 20 and found.count.pictures >= 6
    assert found.samples[-1][1] > 50 and said


def test_the_slope_is_that_of_the_second_half() -> None:
    samples = [(float(at), 100.0 if at < 50 else 100.0 + 0.01 * (at - 50)) for at in range(100)]
    assert abs(Soaked(samples, Count(), 0, [], 1.0).slope - 36.0) < 1e-6
