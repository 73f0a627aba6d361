"""Plane fits are tried from every choice of masks and measured against the truth."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.captures.dataset import Dataset, load_dataset
from glassplat.cli.train import SCENE
from glassplat.evaluate.truth import GroundTruth, load_truth
from tools.plane_errors import Fit, fits_of, main, row


@pytest.fixture(scope="module")
def showcase() -> tuple[Dataset, GroundTruth]:
    dataset = load_dataset(SCENE)
    truth = load_truth(dataset.truth)
    assert truth is not None
    return dataset, truth


def test_the_error_is_the_distance_from_where_the_truth_says(showcase) -> None:
    dataset, truth = showcase
    (pane,) = truth.planes
    shift = 0.1 * dataset.extent * torch.nn.functional.normalize(torch.tensor(pane.normal), dim=0)
    moved = replace(pane, center=tuple((torch.tensor(pane.center) + shift).tolist()))
    (fit,) = fits_of(dataset, dataset.points.positions, replace(truth, planes=(moved,)), 1)
    assert fit.names == tuple(view.name.partition(".")[0] for view in dataset.train if view.is_annotated)
    assert fit.errors is not None
    assert fit.errors[0] < 1
    assert fit.errors[1] == pytest.approx(10, abs=1)
    assert not fit.good


def test_every_choice_of_so_many_masks_is_tried(showcase) -> None:
    dataset, truth = showcase
    annotated = [view for view in dataset.train if view.is_annotated]
    few = replace(dataset, train=tuple(annotated[:3]))
    names = {fit.names for fit in fits_of(few, few.points.positions, truth, 1, masks=2)}
    assert len(names) == 3
    assert all(len(set(chosen)) == 2 for chosen in names)


def test_a_row_counts_what_was_refused_and_what_is_good() -> None:
    fits = [Fit((), (0.5, 0.1), 1.0), Fit((), (3.0, 0.3), 2.0), Fit((), None, 3.0)]
    assert row("case 1", fits) == ["case 1", 3, 1, 1, "1.75 (3.00)", "0.20 (0.30)", 2.0]
    assert row("case 1", fits[2:])[1:6] == [1, 1, 0, "-", "-"]


def test_a_scene_without_truth_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copied = shutil.copytree(SCENE, tmp_path / "scene", ignore=shutil.ignore_patterns("gt"))
    monkeypatch.setattr(sys, "argv", ["plane_errors", "--data", str(copied)])
    with pytest.raises(SystemExit, match=r"has no ground truth; expected gt/planes\.json"):
        main()


def test_the_command_prints_a_row_for_each_pane(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.setattr(sys, "argv", ["plane_errors", "--data", str(SCENE), "--masks", "3", "--every", "1000"])
    main()
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith(f"| {SCENE.name} 1 ")]
    assert len(rows) == 1
    assert [cell.strip() for cell in rows[0].split("|")][2:4] == ["1", "0"]
