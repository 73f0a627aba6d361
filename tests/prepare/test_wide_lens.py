"""Pixels that a wide lens did not see, in photographs undistorted by `prepare`, are excluded from the capture."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from PIL import Image

from glassplat.captures.dataset import load_dataset
from glassplat.prepare.photographs import photographs_in
from glassplat.prepare.reconstruction import write_capture
from tests.captures.conftest import TinyCapture, capture
from tests.prepare.conftest import Heard

__all__ = ["capture"]


@pytest.mark.parametrize(("distortion", "wide"), [(-0.3, True), (-0.05, False)])
def test_pixels_outside_a_wide_lens_are_excluded(
    capture: TinyCapture, distortion: float, wide: bool, tmp_path: Path, heard: Heard
) -> None:
    capture.size = (160, 120)
    capture.lenses = [("SIMPLE_RADIAL", [75.0, 80.0, 60.0, distortion])]
    folder = tmp_path / "photographs"
    for index in range(len(capture.names)):
        (folder / "left").mkdir(parents=True, exist_ok=True)
        Image.new("RGB", capture.size, (250, 250, 255 - index)).save(folder / "left" / f"{index}.png")
    capture.names = [f"{index:06d}.png" for index in range(len(capture.names))]
    database = SimpleNamespace(photographs=photographs_in(folder, 1600, heard))
    solution = SimpleNamespace(models=[capture.reconstruction()], database=database)
    write_capture(cast(Any, solution), tmp_path / "out", heard)
    assert (tmp_path / "out" / "ignore").exists() == wide
    views = load_dataset(tmp_path / "out").train
    assert views[0].name == "left/1.jpg"
    for view in views:
        seen = view.photo if view.ignored is None else view.photo[~view.ignored]
        assert (view.ignored is not None) == wide and bool((seen > 180).all())
        assert view.ignored is None or 0.04 < view.ignored.double().mean() < 0.07
