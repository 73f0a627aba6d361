"""Number of reconstruction attempts, depending on how many photographs are registered."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from glassplat.captures import colmap_library as library
from glassplat.prepare import colmap, reconstruction
from glassplat.prepare.colmap import FeatureOptions, MappingOptions
from glassplat.prepare.photographs import Note
from glassplat.prepare.reconstruction import DEFAULT_FEATURES, MANY_FEATURES, best_solution
from glassplat.training.messages import Working


@dataclass(frozen=True)
class Group:
    """Stands in for a reconstruction of COLMAP."""

    size: int

    def num_reg_images(self) -> int:
        return self.size


@dataclass(frozen=True)
class Matches:
    """Stands in for a database."""

    path: Path
    photographs: tuple[Any, ...]


@pytest.mark.parametrize(
    ("sizes", "least", "features", "best"),
    [
        ([61], 0.8, [DEFAULT_FEATURES], 61),
        ([54, 56], 0.8, [DEFAULT_FEATURES, DEFAULT_FEATURES], 56),
        ([56, 54], 0.8, [DEFAULT_FEATURES, DEFAULT_FEATURES], 56),
        ([54, 54, 62], 0.95, [DEFAULT_FEATURES, DEFAULT_FEATURES, MANY_FEATURES], 62),
        ([62, 62, 62, 64], 1.0, [DEFAULT_FEATURES, DEFAULT_FEATURES, MANY_FEATURES, MANY_FEATURES], 64),
        ([20, 30, 52], 0.8, [DEFAULT_FEATURES, DEFAULT_FEATURES, MANY_FEATURES], 52),
        ([20, 0, 40, 50], 0.8, [DEFAULT_FEATURES, DEFAULT_FEATURES, MANY_FEATURES, MANY_FEATURES], 50),
    ],
)
def test_more_features_only_where_too_few_are_placed(
    monkeypatch: pytest.MonkeyPatch, sizes: list[int], least: float, features: list[FeatureOptions], best: int
) -> None:
    photographs: Any = tuple(range(64))
    tried: list[FeatureOptions] = []
    notes: list[Any] = []

    def matched(photographs: Any, work: Path, features: FeatureOptions, *unused: Any) -> Matches:
        tried.append(features)
        return Matches(work, photographs)

    monkeypatch.setattr(reconstruction, "_match_features", matched)
    left = iter(sizes)

    def placed(*unused: object, **also: object) -> list[Group]:
        return [Group(size)] if (size := next(left)) else []

    monkeypatch.setattr(colmap, "register_photographs", placed)
    solution = best_solution(
        photographs, Path("work"), notes.append, lens="simple_radial", mapper="incremental", least=least
    )
    assert tried == features
    assert (solution.registered, solution.attempts_made) == (best, len(sizes))
    assert len(notes) == len(sizes) - 1 and all(isinstance(note, Note) for note in notes)


def test_a_second_group_is_work_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def mapping(*unused: object, initial_image_pair_callback: Any, next_image_callback: Any, **also: object) -> dict:
        for more in (3, 1):
            initial_image_pair_callback()
            for _ in range(more):
                next_image_callback()
        return {}

    monkeypatch.setattr(library.pycolmap, "incremental_mapping", mapping)
    heard: list[Any] = []
    colmap._incremental_mapping(Path("d"), Path("o"), MappingOptions(), 9, heard.append)(None)
    first, second = "registering the photographs", "registering the photographs, group 2"
    assert heard == [Working(first, done, 9) for done in (2, 3, 4, 5)] + [Working(second, done, 9) for done in (2, 3)]
