"""`glassplat demo` where it cannot start."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from glassplat.cli.main import main
from glassplat.cli.train import LEAST_ITERATIONS
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.training.stage import stages_without_step


def test_a_demo_too_short_for_its_stages_leaves_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--output", str(tmp_path / "demo"), "--iterations", "1"]) == 2
    assert "expected at least" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


def test_the_shortest_demo_has_room_for_all_stages() -> None:
    assert not stages_without_step(PlanarRecipe().stages(0, LEAST_ITERATIONS), LEAST_ITERATIONS)
    assert stages_without_step(PlanarRecipe().stages(0, LEAST_ITERATIONS - 1), LEAST_ITERATIONS - 1)


@pytest.mark.parametrize("file", ["Dockerfile", "Makefile"])
def test_demos_outside_the_package_are_as_short_as_possible(file: str) -> None:
    text = (Path(__file__).parents[2] / file).read_text(encoding="utf-8")
    assert re.findall(r"glassplat demo --iterations (\d+)", text) == [str(LEAST_ITERATIONS)]


@pytest.mark.parametrize("name", ["splat", "planar"])
def test_a_demo_does_not_follow_links_out_of_its_folder(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "demo").mkdir()
    (tmp_path / "mine").write_text("kept")
    (tmp_path / "demo" / name).symlink_to(tmp_path / "mine")
    assert main(["demo", "--output", str(tmp_path / "demo"), "--iterations", "8"]) == 2
    assert "leads out of" in capsys.readouterr().err
    assert (tmp_path / "mine").read_text() == "kept"
