"""The report's page shows every photograph, its camera, and points behind panes; it needs no other file."""

from __future__ import annotations

import html.parser
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from glassplat.captures.dataset import load_dataset
from glassplat.cli.main import main
from glassplat.cli.train import SCENE
from glassplat.errors import InputError
from glassplat.prepare.preparation import PAGE, Report
from glassplat.prepare.report_page import _bin_label, _cards, plan_svg, write_page
from tests.render.tiny_scene import pane

RECORD: dict[str, Any] = {
    "command": "prepare",
    "report": {
        "photographs": 98,
        "registered": 96,
        "missing": ["<b>left & out</b>.jpg"],
        "groups": [96],
        "points": 1000,
        "reprojection_error": 0.5,
        "track_length": 5.0,
        "features": 900,
        "cameras": ["200x150, focal length 166 pixels"],
        "attempt": "the usual settings",
        "attempts": 1,
        "advice": ["take more photographs"],
    },
}


class Parts(html.parser.HTMLParser):
    """Collects the elements of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled scene, as if it had been prepared."""
    folder = tmp_path_factory.mktemp("report") / "the capture"
    shutil.copytree(SCENE, folder, ignore=shutil.ignore_patterns("gt", "*.md"))
    (folder / "prepare.json").write_text(json.dumps(RECORD))
    return folder


def test_every_photograph_is_on_the_page_and_nothing_is_loaded(capture: Path) -> None:
    write_page(capture, capture / PAGE)
    text = (capture / PAGE).read_text()
    page = Parts(text)
    assert len(page.all("img")) == 64
    assert all(str(one["src"]).startswith("data:image/jpeg;base64,") for one in page.all("img"))
    assert (
        "no panes yet" in text and "&lt;b&gt;left &amp; out&lt;/b&gt;.jpg" in text and "take more photographs" in text
    )
    assert not page.all("script") and not page.all("link") and len(text) < 2_000_000


def test_with_panes_the_points_behind_them_are_counted(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(capture), "--page", str(capture / PAGE)]) == 0
    told = re.search(r"points behind panes: (\d+)", capsys.readouterr().out)
    assert told and int(told[1]) > 0
    text = (capture / PAGE).read_text()
    assert f"<b>{int(told[1]):,} (" in text
    assert text.count('fill="#ff4fd8"') > 0 and text.count('stroke="#ffd24a"') == 1


def test_without_points_none_is_behind_panes() -> None:
    cards = _cards(Report(**RECORD["report"]), np.zeros(0, dtype=bool), pane(2.0))
    assert "<div><b>0 (0%)</b><span>points behind panes</span></div>" in cards


def test_a_foreign_file_is_not_overwritten(capture: Path, tmp_path: Path) -> None:
    target = tmp_path / "mine.html"
    target.write_text("mine")
    for page in (target, target / "page.html", tmp_path):
        assert main(["info", str(capture), "--page", str(page)]) == 2
    assert target.read_text() == "mine"


def test_a_capture_that_prepare_did_not_make_has_no_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(SCENE), "--page", str(tmp_path / "page.html")]) == 2
    told = capsys.readouterr()
    assert "was not made by `glassplat prepare`" in told.err and not told.out, "before it is looked through"
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(
    "record",
    [{}, [], {"report": None}, {"report": {}}, {"report": {**RECORD["report"], "points": "many"}}, "cut off"],
)
def test_a_record_without_a_report_is_named(record: object, tmp_path: Path) -> None:
    (tmp_path / "prepare.json").write_text(str(record) if record == "cut off" else json.dumps(record))
    with pytest.raises(InputError, match=r"prepare\.json.*; prepare the capture again"):
        write_page(tmp_path, tmp_path / PAGE)
    assert not (tmp_path / PAGE).exists()


def test_cameras_in_the_plan_have_their_positions() -> None:
    dataset = load_dataset(SCENE)
    views = sorted(dataset.train, key=lambda view: view.name)
    drawing = plan_svg(views, dataset.points, np.zeros(len(dataset.points), dtype=bool), None)
    found = re.findall(r'cx="([\d.-]+)" cy="([\d.-]+)" r="2.6"', drawing)
    pixels = np.array(found, dtype=np.float64)
    centers = np.stack([view.camera.center.double().numpy() for view in views])
    away = np.linalg.norm(pixels[:, None] - pixels, axis=-1)
    level = np.linalg.norm((centers[:, None] - centers) @ _level(views), axis=-1)
    scale = away.max() / level.max()
    np.testing.assert_allclose(away, scale * level, atol=0.3)
    assert (pixels > 0).all() and (pixels < (640, 440)).all()


def _level(views: list) -> np.ndarray:
    """[3, 3] projection that removes the height."""
    up = -np.mean([view.camera.cam_from_world[1, :3].double().numpy() for view in views], axis=0)
    up /= np.linalg.norm(up)
    return np.eye(3) - np.outer(up, up)


def test_bins_of_whole_numbers_do_not_overlap() -> None:
    assert [_bin_label(2, 3), _bin_label(5, 7), _bin_label(15, 1 << 30), _bin_label(0.25, 0.5)] == [
        "2",
        "5 to 6",
        "15 and more",
        "0.25 to 0.5",
    ]
