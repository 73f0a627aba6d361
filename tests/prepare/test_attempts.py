"""How often photographs are tried, by how many find their place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from glassplat.prepare import reconstruction
from glassplat.prepare.colmap import Features
from glassplat.prepare.photographs import Note
from glassplat.prepare.reconstruction import MANY, USUAL, Settings, best_solution


@dataclass(frozen=True)
class Group:
    """In place of a reconstruction of COLMAP."""

    size: int

    def num_reg_images(self) -> int:
        return self.size


@dataclass(frozen=True)
class Matches:
    """In place of a database."""

    path: Path
    photographs: tuple[Any, ...]


@pytest.mark.parametrize(
    ("sizes", "least", "features", "best"),
    [
        ([61], 0.8, [USUAL], 61),
        ([54, 56], 0.8, [USUAL, USUAL], 56),
        ([56, 54], 0.8, [USUAL, USUAL], 56),
        ([54, 54, 62], 0.95, [USUAL, USUAL, MANY], 62),
        ([62, 62, 62, 64], 1.0, [USUAL, USUAL, MANY, MANY], 64),
        ([20, 30, 52], 0.8, [USUAL, USUAL, MANY], 52),
        ([20, 0, 40, 50], 0.8, [USUAL, USUAL, MANY, MANY], 50),
    ],
)
def test_more_features_only_where_too_few_are_placed(
    monkeypatch: pytest.MonkeyPatch, sizes: list[int], least: float, features: list[Features], best: int
) -> None:
    photographs: Any = tuple(range(64))
    tried: list[Features] = []
    notes: list[Any] = []

    def matched(photographs: Any, work: Path, features: Features, *unused: Any) -> Matches:
        tried.append(features)
        return Matches(work, photographs)

    monkeypatch.setattr(reconstruction, "_match_features", matched)
    left = iter(sizes)

    def placed(*unused: object, **also: object) -> list[Group]:
        return [Group(size)] if (size := next(left)) else []

    monkeypatch.setattr(reconstruction, "place_photographs", placed)
    solution = best_solution(photographs, Path("work"), Settings(), least, notes.append)
    assert tried == features
    assert (solution.registered, solution.tried) == (best, len(sizes))
    assert len(notes) == len(sizes) - 1 and all(isinstance(note, Note) for note in notes)
