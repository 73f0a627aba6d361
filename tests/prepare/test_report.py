"""The report counts the registered photographs, and advises on possible improvements."""

from __future__ import annotations

import io
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from glassplat.cli.capture import Prepare
from glassplat.files.records import read_json
from glassplat.prepare.photographs import Photograph
from glassplat.prepare.preparation import Preparation, make_report
from glassplat.prepare.reconstruction import Solution


class FakeDatabase:
    """The part of a database that a report uses."""

    def __init__(self, count: int, features: int) -> None:
        self.photographs = [Photograph(Path(f"{k}.jpg"), f"{k}.jpg", 640, 480, "", None) for k in range(count)]
        self._features = features

    def feature_counts(self) -> np.ndarray:
        return np.full(len(self.photographs), self._features)


class FakeImage:
    """An image of a model."""

    def __init__(self, number: int) -> None:
        self.name, self.camera_id, self.has_pose = f"{number:06d}.png", 1, True


class FakeCamera:
    """A lens."""

    width, height = 640, 480

    def __init__(self, focal: float) -> None:
        self._focal = focal

    def mean_focal_length(self) -> float:
        return self._focal


class FakeModel:
    """The part of a reconstruction that a report uses."""

    def __init__(self, numbers: range, *, track: float = 5.0, error: float = 0.5, focal: float = 600.0) -> None:
        self.images = {k: FakeImage(k) for k in numbers}
        self.cameras = {1: FakeCamera(focal)}
        self._track, self._error = track, error

    def num_reg_images(self) -> int:
        return len(self.images)

    def num_points3D(self) -> int:  # noqa: N802 - Named as in pycolmap.
        return 1000

    def compute_mean_track_length(self) -> float:
        return self._track

    def compute_mean_reprojection_error(self) -> float:
        return self._error


def report(models: list[Any], *, count: int = 10, features: int = 3000) -> Any:
    return make_report(Solution(FakeDatabase(count, features), models, "the usual settings", 1))  # type: ignore[arg-type]


def test_names_that_are_not_unicode_can_be_read_back(tmp_path: Path) -> None:
    solution = Solution(FakeDatabase(4, 3000), [FakeModel(range(3))], "", 1)  # type: ignore[arg-type]
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    solution.database.photographs[3] = Photograph(folder / os.fsdecode(b"\xe9.jpg"), "_.jpg", 640, 480, "", None)
    record = {"report": asdict(make_report(solution)), **Preparation(folder, tmp_path).record()}
    (tmp_path / "record.json").write_text(json.dumps(record))
    found = read_json(tmp_path / "record.json")
    assert found["report"]["missing"] == [r"\xe9.jpg"] and found["input"].endswith(r"caf\xe9")
    assert r"take more photographs around \xe9.jpg" in found["report"]["advice"][0]


def test_a_complete_preparation_gets_no_advice() -> None:
    found = report([FakeModel(range(10))])
    assert found.registered_share == 1 and found.groups == (10,) and found.advice == () and found.missing == ()
    assert found.lines()[0].startswith("10 of 10 photographs registered, with")


def test_photographs_registered_twice_form_no_second_group() -> None:
    assert report([FakeModel(range(10)), FakeModel(range(3, 7)), FakeModel(range(2))]).groups == (10,)


def test_two_places_are_two_groups() -> None:
    found = report([FakeModel(range(6)), FakeModel(range(5, 10))])
    assert found.groups == (6, 4) and found.missing == ("6.jpg", "7.jpg", "8.jpg", "9.jpg")
    assert any("2 groups without matches between them (6, 4 photographs)" in line for line in found.advice)
    assert any("take more photographs around 6.jpg" in line for line in found.advice)


@pytest.mark.parametrize(
    ("model", "features", "expected"),
    [
        ({"track": 2.2}, 3000, "in smaller steps"),
        ({"error": 2.0}, 3000, "nothing large moves"),
        ({"focal": 5000.0}, 3000, "focal length is implausible"),
        ({}, 200, "only 200 features"),
    ],
)
def test_poor_reconstructions_get_advice(model: dict[str, float], features: int, expected: str) -> None:
    (line,) = report([FakeModel(range(10), **model)], features=features).advice
    assert expected in line


def test_a_reconstruction_without_photographs_is_reported() -> None:
    found = report([])
    assert found.registered == 0 and found.points == 0 and len(found.missing) == 10


def test_advice_has_one_label(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, file = report([FakeModel(range(10))], features=200), io.StringIO()
    monkeypatch.setattr("glassplat.cli.capture.prepare", lambda *task, **options: found)
    monkeypatch.setattr("glassplat.prepare.report_page.write_page", lambda *places: None)
    Prepare(tmp_path, tmp_path / "capture").run(Console(file=file, width=200))
    assert f"\nadvice: {found.advice[0]}\n" in file.getvalue()
