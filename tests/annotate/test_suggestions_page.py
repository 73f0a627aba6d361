"""Suggested panes in a real browser: they are drawn dashed, taken as marked panes, dragged, undone and dropped."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from glassplat.data.dataset import load_dataset
from tests.annotate.conftest import true_corners
from tests.annotate.suggested import suggestions
from tests.browser_needed import needs_browser
from tests.init.pane_scene import FRONT
from tools.browser import wait_until
from tools.marking_page import MarkingPage, marking_page

pytestmark = needs_browser


@pytest.fixture
def page(room: Path) -> Iterator[MarkingPage]:
    with marking_page(room, suggestions=suggestions()) as opened:
        yield opened


def yellow(page: MarkingPage, view: int) -> float:
    """The share of yellow pixels in the window along a pane's true outline."""
    page.show(view)
    picture = page.window.picture().astype(int)
    corners = true_corners(view)
    share = np.linspace(0, 1, 200)[:, None]
    sides = [one + share * (other - one) for one, other in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    places = np.round(page.on_screen(np.concatenate(sides))).astype(int)
    shown = picture[places[:, 1], places[:, 0]]
    return float(((shown[:, 0] > 200) & (shown[:, 1] > 180) & (shown[:, 2] < 170)).mean())


def panes(page: MarkingPage) -> list[dict]:
    return json.loads((page.server.session.root / "annotations.json").read_text())["panes"]


def test_a_suggestion_is_shown_taken_and_written(page: MarkingPage) -> None:
    assert yellow(page, 1) > 0.3, "half of a dashed outline"
    page.window.keys("y")
    page.window.wait("document.querySelectorAll('.suggestion').length === 0", "the suggestion to be taken")
    page.saved()
    wait_until(lambda: len(panes(page)) == 1 and all(len(places) == 3 for places in panes(page)[0]["corners"]), "marks")
    assert yellow(page, 1) < 0.05
    assert "the plane is sure to" in page.said()
    assert page.write() == "written: 3 masks, 1 planes"
    planes = load_dataset(page.server.session.root).planes
    assert planes is not None
    assert abs(float(planes.normals[0].double().numpy() @ FRONT.normal)) > np.cos(np.radians(1))
    page.window.press("#undo")
    wait_until(lambda: not any(panes(page)[0]["corners"]), "the marks to be gone")


def test_a_suggestion_that_was_taken_is_not_made_again(page: MarkingPage) -> None:
    page.window.keys("y")
    page.saved()
    wait_until(lambda: bool(panes(page)) and bool(panes(page)[0]["corners"][0]), "marks")
    page.open()
    assert page.window.run("return document.querySelectorAll('.suggestion').length") == 0


def test_a_suggestion_is_dropped(page: MarkingPage) -> None:
    assert "7 things are seen in it" in page.window.run("return document.getElementById('suggestions').innerText")
    page.window.keys("x")
    assert page.window.run("return document.querySelectorAll('.suggestion').length") == 0
    assert yellow(page, 0) < 0.05
    assert not any(panes(page)[0]["corners"])
