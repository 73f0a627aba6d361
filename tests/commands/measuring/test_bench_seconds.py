"""`glassplat bench seconds`: runs whose length follows from the time that others took."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from glassplat.cli import main
from glassplat.commands.measuring.bench_seconds import iterations_for
from glassplat.commands.measuring.seconds_chart import Curve, chart, ticks
from tests.train.tiny_capture import write_tiny_capture


def test_a_length_follows_from_the_power_law_through_two_runs() -> None:
    timed = [(300, 3 * 300**1.5 / 1000), (1200, 3 * 1200**1.5 / 1000)]
    assert iterations_for(3 * 2500**1.5 / 1000, timed) == 2500


def test_the_second_run_is_as_long_as_usual_growth_allows() -> None:
    assert iterations_for(100.0, [(300, 10.0)]) == round(300 * 10 ** (1 / 1.2), -1)


def test_no_run_is_shorter_than_the_pilot() -> None:
    assert iterations_for(1.0, [(300, 50.0)]) == 300


def test_times_that_contradict_any_law_do_not_run_away() -> None:
    assert iterations_for(200.0, [(300, 100.0), (600, 100.0)]) == 1200


@pytest.mark.parametrize(("low", "high"), [(0.0, 240.0), (31.2, 37.9), (20.0, 20.0), (0.0, 0.7), (-3.0, 4000.0)])
def test_ticks_are_few_and_round_and_hold_all_values(low: float, high: float) -> None:
    found = ticks(low, high)
    assert found[0] <= low and found[-1] >= high
    assert 2 <= len(found) <= 8


def test_a_chart_is_svg_with_a_line_for_each_curve() -> None:
    drawn = chart("a <b>", [Curve("splat", ((10.0, 30.0), (20.0, 32.0))), Curve("planar", ((12.0, 31.0),))])
    root = ElementTree.fromstring(drawn)
    names = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"a <b>", "splat", "planar"} <= set(names)
    lines = [element.get("points") for element in root.iter("{http://www.w3.org/2000/svg}polyline")]
    assert [len(points.split()) for points in lines if points] == [2, 1]
    first, second = (tuple(map(float, point.split(","))) for point in (lines[0] or "").split())
    assert first[0] < second[0] and first[1] > second[1]


def test_methods_are_trained_for_given_times_and_drawn_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture, output = write_tiny_capture(tmp_path / "tiny"), tmp_path / "bench"
    command = ["bench", "seconds", "--data", str(capture), "--output", str(output), "--methods", "splat", "planar"]
    command += ["--pilot", "10", "--seconds", "1"]
    assert main(command) == 0
    runs = json.loads((output / "seconds.json").read_text())["runs"]
    assert [(run["method"], run["asked"]) for run in runs] == [
        ("splat", 0.0),
        ("splat", 1.0),
        ("planar", 0.0),
        ("planar", 1.0),
    ]
    assert runs[0]["iterations"] == 10 < runs[1]["iterations"]
    table = (output / "seconds.md").read_text()
    assert "![tiny](seconds-tiny.svg)" in table and "| tiny | planar | 10 |" in table
    ElementTree.parse(output / "seconds-tiny.svg")
    capsys.readouterr()

    (output / "seconds.md").unlink()
    assert main(command) == 0
    assert "trained splat" not in capsys.readouterr().out
    assert (output / "seconds.md").read_text() == table


def test_nothing_to_compare_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bench", "seconds", "--data", "x", "--output", str(tmp_path / "out"), "--seconds", "0"]
    assert main(command) == 2
    assert "1" in capsys.readouterr().err
