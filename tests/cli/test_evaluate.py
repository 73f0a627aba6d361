"""Output of the results of `glassplat eval` and `demo`."""

from __future__ import annotations

import pytest
from rich.console import Console

from glassplat.cli.console import message_console
from glassplat.cli.evaluation import plane_text, print_results, result_notes
from glassplat.evaluate.evaluate import SCENE_COLORS

NO_WEIGHTS = "no LPIPS weights in [folder]; get vgg.pth"
PLANAR = {
    "method": "planar",
    "psnr": 31.234,
    "lpips": None,
    "lpips_reason": NO_WEIGHTS,
    "pane_psnr": None,
    "pane_psnr_reason": "the data set has no ground truth",
    "transmission_psnr": None,
    "transmission_psnr_reason": "the data set has no ground truth",
    "num_gaussians": 12345,
    "seconds_per_frame": 0.0312,
    "normal_error_deg": None,
    "normal_error_deg_reason": "the method renders no normals",
    "planes": [{"label": 1, "base_reflectance": 0.0432, "normal_error_deg": None}],
}
SPLAT = {"method": "splat", "psnr": 29.0, "lpips": 0.2, "num_gaussians": 54321, "planes": []}
KNOWN_PLANE = {
    "label": 2,
    "base_reflectance": 0.04,
    "base_reflectance_error": 0.001,
    "normal_error_deg": 0.25,
    "offset_error": 0.0031,
}


def shown(capsys: pytest.CaptureFixture[str], *results: dict) -> str:
    print_results(message_console(), *results)
    return " ".join(capsys.readouterr().out.split())


def test_numbers_have_their_units_and_a_dash_has_its_reason(capsys: pytest.CaptureFixture[str]) -> None:
    said = shown(capsys, PLANAR)
    for words in ("31.23 dB", "12,345", "0.031 s", "R0 0.043"):
        assert words in said
    assert f"no lpips: {NO_WEIGHTS}" in said
    assert "no pane_psnr, transmission_psnr: the data set has no ground truth" in said
    assert "normal_error" not in said


def test_a_table_of_several_runs_names_missing_values(capsys: pytest.CaptureFixture[str]) -> None:
    assert result_notes(PLANAR, SPLAT)[0] == f"planar: no lpips: {NO_WEIGHTS}"
    said = shown(capsys, PLANAR, SPLAT)
    assert "31.23 dB" in said and "29.00 dB" in said
    assert result_notes(SPLAT) == []
    aligned = SPLAT | {"test_cameras": "aligned with their photographs", "test_exposures": SCENE_COLORS}
    assert result_notes(aligned) == ["cameras of test views: aligned with their photographs"]
    partial = SPLAT | {"psnr_views": 2, "pane_psnr": None, "pane_psnr_views": 2, "num_test_views": 3}
    assert result_notes(partial | {"pane_psnr_reason": "equal"})[0].startswith("psnr: means over 2 of 3 test views")


def test_errors_of_a_pane_are_printed_with_their_quantities() -> None:
    expected = "R0 0.040 (error 0.001), normal off by 0.25°, centre by 0.31 % of the extent"
    assert plane_text(KNOWN_PLANE) == expected


def test_results_can_be_shown_in_a_terminal() -> None:
    with Console(force_terminal=True, width=60) as console, console.capture() as captured:
        print_results(console, PLANAR)
    assert "[folder]" in captured.get()
