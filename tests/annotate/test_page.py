"""The page in a real browser: corners are clicked, panes appear, are cut, undone and written; pixels are compared."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from glassplat.captures.dataset import load_dataset
from glassplat.files.images import read_image
from tests.annotate.conftest import NAMES, marked_document, saved, true_corners
from tests.browser_needed import needs_browser
from tests.panes.pane_scene import FRONT
from tools.browser import wait_until
from tools.marking_page import MarkingPage, marking_page

pytestmark = [needs_browser, pytest.mark.usefixtures("one_chromium")]


class Page(MarkingPage):
    """The page for marking, with helpers for the tests."""

    @property
    def root(self) -> Path:
        return self.server.session.root

    def mark_true(self, view: int) -> None:
        """Clicks the true corners."""
        self.mark(view, true_corners(view))

    def color_at(self, place: tuple[float, float]) -> np.ndarray:
        """[3] the colour that the window shows at a position in the photograph."""
        ((x, y),) = self.on_screen(np.array([place]))
        return self.window.picture()[round(y), round(x)].astype(int)

    def document(self) -> dict:
        return json.loads((self.root / "annotations.json").read_text())["panes"][0]


@pytest.fixture
def page(room: Path) -> Iterator[Page]:
    with marking_page(room) as opened:
        yield Page(opened.window, opened.server)


FULL = "there can be 64 panes at most"


def is_blue(color: np.ndarray) -> bool:
    """True if the first pane's colour is drawn over the grey photograph."""
    return bool(color[2] > color[0] + 15)


def complaints(page: Page) -> list[str]:
    """Errors of the page; browsers may request an icon by themselves."""
    return [said for said in page.window.complaints() if not said.startswith("Failed to load resource")]


def test_a_pane_is_marked_cut_and_written(page: Page) -> None:
    middle = true_corners(3).mean(axis=0)
    page.show(3)
    assert not is_blue(page.color_at(middle))
    page.mark_true(0)
    assert page.window.run("return document.querySelectorAll('#views .suggested').length") > 0
    page.mark_true(1)
    page.mark_true(2)
    page.show(3)  # Nothing was clicked here: the pane appears at its predicted position.
    assert is_blue(page.color_at(middle))
    outside = true_corners(3)[0] - (12, 12)
    assert not is_blue(page.color_at(tuple(outside)))
    assert "pixels; the plane is uncertain by" in page.window.run("return document.getElementById('panes').textContent")

    page.show(0)
    corners = true_corners(0)
    hedge = np.array([corners[3], corners[2], (corners[2] + corners[1]) / 2, (corners[3] + corners[0]) / 2])
    inside = tuple((corners[3] + corners[2]) / 2 * 0.85 + corners.mean(axis=0) * 0.15)
    assert is_blue(page.color_at(inside))
    page.window.keys("3")
    for x, y in page.on_screen(hedge):
        page.window.click(x, y)
    page.window.keys("Enter")
    page.saved()
    assert not is_blue(page.color_at(inside))
    assert is_blue(page.color_at(tuple(corners[:2].mean(axis=0) * 0.8 + corners.mean(axis=0) * 0.2)))

    assert page.write() == "written: 3 masks, 1 plane"
    dataset = load_dataset(page.root)
    assert dataset.planes is not None and dataset.pane_labels == (1,)
    turned = math.degrees(math.acos(min(1.0, abs(float(dataset.planes.normals[0].double().numpy() @ FRONT.normal)))))
    assert turned < 1
    cut, whole = (read_image(page.root / "panes" / name)[:, :, 0] for name in NAMES[:2])
    assert whole[tuple(true_corners(1).mean(axis=0).astype(int)[::-1])] == 1
    assert cut[round(inside[1]), round(inside[0])] == 0
    assert 0.35 < (cut == 1).sum() / (read_image(page.root / "images" / NAMES[0])[:, :, 0] == 150).sum() < 0.65
    saved(page.server.session, {"version": 1, "panes": []})
    assert page.write().startswith(
        "no pane is marked; removed the earlier output: planes.json, panes/0.png, panes/1.png"
    )


def test_occluders_are_found_within_a_rough_outline(room: Path) -> None:
    picture = room / "images" / NAMES[0]
    pixels = read_image(picture).copy()
    x, y = true_corners(0).mean(axis=0).astype(int)
    hedge = np.s_[y - 20 : y + 20, x - 25 : x + 10]
    mottle = np.random.default_rng(0).integers(-8, 9, (40, 35, 1))
    pixels[hedge] = np.array([90, 40, 30]) + mottle
    Image.fromarray(pixels).save(picture)
    with marking_page(room) as opened:
        page = Page(opened.window, opened.server)
        for view in range(3):
            page.mark_true(view)
        page.show(0)
        inside, beside = (x - 8, y), (x + 17, y)
        covered = page.color_at(inside)
        page.window.keys("5")
        for place in page.on_screen([(x - 37, y - 30), (x + 22, y - 30), (x + 22, y + 30), (x - 37, y + 30)]):
            page.window.click(*place)
        page.window.keys("Enter")
        page.window.wait("document.body.dataset.grab === 'done'", "the outline")
        page.saved()
        assert page.color_at(inside)[2] < covered[2] - 15 and is_blue(page.color_at(beside))
        page.write()
        mask = read_image(room / "panes" / NAMES[0])[:, :, 0]
        assert (mask[hedge] == 0).mean() > 0.97
        around = mask[y - 30 : y + 30, x - 37 : x + 22].size - mask[hedge].size
        assert (mask[y - 30 : y + 30, x - 37 : x + 22] == 1).sum() > 0.93 * around
        page.window.press("#undo")
        page.saved()
        assert np.abs(page.color_at(inside) - covered).max() < 4


def test_corners_are_dragged_undone_and_survive_a_reload(page: Page) -> None:
    page.mark_true(0)
    before = page.document()["corners"][2]["0.png"]
    (start,) = page.on_screen(np.array([before]))
    page.window.drag([start, (start[0] + 20, start[1] + 10), (start[0] + 40, start[1] + 20)])
    page.saved()
    dragged = page.document()["corners"][2]["0.png"]
    assert dragged[0] > before[0] + 5 and dragged[1] > before[1] + 2
    page.window.keys("Control", "z")  # A drag is one step.
    wait_until(lambda: page.document()["corners"][2]["0.png"] == before, "the corner to be back")
    page.window.press("#redo")
    wait_until(lambda: page.document()["corners"][2]["0.png"] == dragged, "the corner to be dragged again")
    page.open()
    assert page.window.run("return document.querySelectorAll('#views .marked').length") == 1
    assert page.document()["corners"][2]["0.png"] == dragged


def test_a_fitted_corner_without_a_mark_can_be_dragged(page: Page) -> None:
    page.mark_true(0)
    page.mark_true(1)
    page.show(2)
    (start,) = page.on_screen(true_corners(2)[1:2])
    page.window.drag([start, (start[0] + 6, start[1])])
    page.saved()
    assert "2.png" in page.document()["corners"][1]


def test_only_a_plane_certain_to_half_a_degree_is_green(page: Page) -> None:
    for view, count in enumerate((0, 0, 1)):
        page.mark_true(view)
        assert page.window.run("return document.querySelectorAll('#panes .good').length") == count, page.said()


def test_a_marked_corner_keeps_its_distance_from_the_pointer(page: Page) -> None:
    page.mark_true(0)
    ((x, y),) = page.on_screen(true_corners(0)[1:2])
    page.window.drag([(x + 5, y + 4), (x + 7, y + 4), (x + 5, y + 4)])
    page.saved()
    assert np.allclose(page.document()["corners"][1]["0.png"], true_corners(0)[1], atol=0.5)


def test_a_fitted_corner_is_marked_where_it_is_pressed(page: Page) -> None:
    """Marked where the fit expects it, it would confirm the fit, whatever the photograph shows."""
    for view in (0, 1):
        page.mark_true(view)
    page.show(2)
    expected = true_corners(2)[1]
    places = expected + np.array([(2.0, 1.0), (9.0, 0.0), (0.0, 0.0)])
    pressed, dragged, again = page.on_screen(places)
    page.window.click(*pressed)
    page.saved()
    np.testing.assert_allclose(page.document()["corners"][1]["2.png"], places[0], atol=0.5)
    page.window.drag([pressed, dragged])
    page.saved()
    page.window.click(*again)  # The second corner is elsewhere by now, so this marks the first.
    page.saved()
    first, second, *_ = page.document()["corners"]
    np.testing.assert_allclose([first["2.png"], second["2.png"]], [expected, places[1]], atol=0.5)


def test_there_are_at_most_64_panes_and_each_has_its_colour_and_is_shown(page: Page) -> None:
    for _ in range(62):
        page.window.keys("a")
    page.saved()
    page.window.keys("a")
    top = page.window.run("return document.querySelector('.pane.active').getBoundingClientRect().top")
    assert 0 < top < 900
    page.saved()
    page.window.keys("a")
    assert page.window.run("return document.getElementById('status').textContent") == FULL
    assert len(json.loads((page.root / "annotations.json").read_text())["panes"]) == 64
    colors = "[...document.querySelectorAll('.pane i')].map((swatch) => swatch.style.background)"
    assert page.window.run(f"return new Set({colors}).size") == 64


def test_the_menus_of_a_pane_keep_the_focus_when_a_choice_is_saved(page: Page) -> None:
    page.window.run("document.querySelector('select[title=material]').focus()")
    for expected in ("mirror", "screen"):
        page.window.keys("Down")
        page.saved()
        assert page.document()["material"] == expected


def test_a_menu_stays_in_place_when_its_pane_is_chosen_by_a_click_on_it(page: Page) -> None:
    page.window.keys("a")
    page.saved()
    page.window.run("window.menu = document.querySelector('.pane:not(.active) select'); window.menu.click()")
    assert page.window.run("return window.menu.isConnected && window.menu.closest('.pane').matches('.active')")


def test_shift_and_tab_lead_to_the_buttons(page: Page) -> None:
    page.window.run("document.getElementById('canvas').focus()")
    page.window.keys("Shift", "Tab")
    assert page.window.run("return document.activeElement.tagName") == "BUTTON"


def test_the_photograph_fits_a_narrow_window(room: Path) -> None:
    with marking_page(room, width=390, height=844) as opened:
        page = Page(opened.window, opened.server)
        page.mark_true(0)
        marked = [places["0.png"] for places in page.document()["corners"]]
        np.testing.assert_allclose(marked, true_corners(0), atol=0.02)
        assert page.window.run("return document.documentElement.scrollWidth") == 390


def test_keys_choose_photographs_panes_and_brushes(page: Page) -> None:
    page.mark_true(0)
    page.mark_true(1)
    page.show(0)
    page.window.keys("Right")
    page.window.wait("document.body.dataset.view === '1'", "the next photograph")
    page.window.keys("4")
    middle = true_corners(1).mean(axis=0)
    ((x, y),) = page.on_screen(middle[None])
    page.window.drag([(x - 30, y), (x, y), (x + 30, y)])
    page.saved()
    assert not is_blue(page.color_at(tuple(middle)))
    assert page.document()["strokes"]["1.png"][0]["kind"] == "brush"
    page.window.keys("6")
    page.window.drag([(x - 30, y), (x, y), (x + 30, y)])
    page.saved()
    assert is_blue(page.color_at(tuple(middle)))
    page.window.keys("a")
    page.saved()
    assert page.window.run("return document.querySelectorAll('.pane').length") == 2


def test_the_mark_under_the_pointer_is_removed_after_a_drag(page: Page) -> None:
    page.mark_true(0)
    (start,) = page.on_screen(true_corners(0)[:1])
    page.window.drag([start, (start[0] + 60, start[1] + 60)])
    page.window.keys("Delete")
    page.saved()
    assert [len(places) for places in page.document()["corners"]] == [0, 1, 1, 1]


def test_a_cancelled_touch_ends_the_drag(page: Page) -> None:
    page.mark_true(0)
    before = page.document()["corners"]
    page.window.run(
        "const [x, y] = arguments[0], canvas = document.getElementById('canvas');"
        "canvas.setPointerCapture = () => {};"  # It rejects pointers of a script.
        "for (const [kind, way] of [['down', 0], ['cancel', 0], ['move', 50]])"
        "  canvas.dispatchEvent(new PointerEvent(`pointer${kind}`, { clientX: x + way, clientY: y + way }));",
        page.on_screen(true_corners(0)[:1])[0],
    )
    page.saved()
    assert page.document()["corners"] == before


def test_a_surplus_polygon_corner_can_be_removed(page: Page) -> None:
    page.window.run(
        "const shape = document.querySelector('select[title=shape]');"
        "shape.value = 'polygon'; shape.dispatchEvent(new Event('change'));"
    )
    page.mark(0, [*true_corners(0), (20, 20)])
    assert len(page.document()["corners"]) == 5
    page.window.keys("Delete")
    page.mark_true(1)
    assert len(page.document()["corners"]) == len(page.document()["edges"]) == 4
    assert "pixels; the plane is uncertain by" in page.said()


def test_undo_cancels_an_unfinished_line_before_it_undoes_marks(page: Page) -> None:
    page.mark_true(0)
    page.window.keys("3")
    for place in page.on_screen(true_corners(0)[:3]):
        page.window.click(*place)
    page.window.keys("Control", "z")
    page.window.keys("Enter")
    page.saved()
    assert page.document()["strokes"] == {}
    assert [len(places) for places in page.document()["corners"]] == [1, 1, 1, 1]
    for place in page.on_screen(true_corners(0)[:3]):
        page.window.click(*place)
    page.window.press(".pane h2 button")  # Removes the pane.
    page.window.keys("Enter")
    page.saved()
    assert complaints(page) == []


@pytest.mark.parametrize("switch", ["Tab", "Control+z", "remove"])
def test_an_unfinished_line_is_dropped_when_the_pane_changes(switch: str, page: Page) -> None:
    """However the pane changes; a line removed by undo cannot be continued either."""
    page.mark_true(0)
    page.window.keys("a")
    page.window.keys("3")
    for place in page.on_screen(true_corners(0)[:3]):
        page.window.click(*place)
    if switch == "remove":
        page.window.press(".pane.active h2 button")
    else:
        page.window.keys(*switch.split("+"))
    page.window.keys("Enter")
    page.saved()
    panes = json.loads((page.root / "annotations.json").read_text())["panes"]
    assert [pane["strokes"] for pane in panes] == [{}] * len(panes)


def test_a_zoomed_photograph_stays_where_it_is_while_the_header_grows(page: Page) -> None:
    def marks() -> list[int]:
        return [len(places) for places in page.document()["corners"]]

    middle = "const box = document.getElementById('canvas').getBoundingClientRect();"
    middle += "const [x, y] = [box.left + box.width / 2, box.top + box.height / 2];"
    page.show(0)
    page.window.run(
        middle + "const at = { clientX: x + 150, clientY: y, deltaY: -400 };"
        "document.getElementById('canvas').dispatchEvent(new WheelEvent('wheel', at));"
    )
    page.window.click(*page.window.run(f"{middle} return [x, y];"))
    page.saved()
    page.window.run("document.querySelector('header').style.height = '200px'")
    page.window.evaluate("new Promise((next) => requestAnimationFrame(() => requestAnimationFrame(next)))")
    page.window.click(*page.window.run(f"{middle} return [x, y];"))
    page.saved()
    assert marks() == [1, 0, 0, 0]  # The same one was dragged.
    page.window.keys("0")
    page.window.run("document.querySelector('header').style.height = '100px'")
    page.window.evaluate("new Promise((next) => requestAnimationFrame(() => requestAnimationFrame(next)))")
    page.window.click(*page.on_screen([(20, 20)])[0])  # When shown as a whole, it is fitted again.
    page.saved()
    assert page.document()["corners"][1]["0.png"] == pytest.approx([20, 20], abs=1)


def test_the_space_key_is_released_when_the_window_loses_focus(page: Page) -> None:
    page.show(0)
    page.window.run("document.body.dispatchEvent(new KeyboardEvent('keydown', { key: ' ', bubbles: true }))")
    page.window.run("window.dispatchEvent(new Event('blur'))")
    page.window.click(*page.on_screen(true_corners(0)[:1])[0])
    page.saved()
    assert [len(places) for places in page.document()["corners"]] == [1, 0, 0, 0]


def test_space_presses_a_button_that_has_focus(page: Page) -> None:
    chosen = "return document.querySelector('[aria-pressed=true]').dataset.tool"
    page.window.run("document.querySelector('[data-tool=edge]').focus()")
    page.window.keys(" ")
    assert page.window.run(chosen) == "edge"
    page.window.press("[data-tool=brush]")  # A mouse click leaves no focus, so that Space moves the photograph.
    page.window.keys("1")
    page.window.keys(" ")
    assert page.window.run(chosen) == "corner"


def test_edges_suffice_where_no_corner_is_visible(page: Page) -> None:
    for view in (0, 1, 2):
        corners = true_corners(view)
        ends = [(corners[k], corners[(k + 1) % 4]) for k in range(4)]
        page.mark_edges(view, [np.stack([a + 0.3 * (b - a), a + 0.7 * (b - a)]) for a, b in ends])
    page.show(3)
    assert is_blue(page.color_at(tuple(true_corners(3).mean(axis=0))))


def test_changes_during_saving_are_not_reported_as_saved(page: Page) -> None:
    page.mark_true(0)
    page.window.run(
        "const asked = window.fetch; window.fetch = async (...request) => {"
        "  const answer = await asked(...request);"
        "  if (!window.seen) {"
        "    window.seen = 'nothing'; document.getElementById('undo').click();"
        "    setTimeout(() => { window.seen = document.body.dataset.state }, 60);"  # Before the next request starts.
        "  }"
        "  return answer; };"
    )
    page.window.press("#undo")
    page.window.wait("window.seen && window.seen !== 'nothing'", "a change during an answer")
    assert page.window.run("return window.seen") == "changed"
    page.saved()
    assert [len(places) for places in page.document()["corners"]] == [1, 1, 0, 0]


REFUSED = 'new Response(\'{"error": "the disk is full"}\', { status: 400 })'
ENDED = "Promise.reject(new TypeError('Failed to fetch'))"


@pytest.mark.parametrize(("answer", "text"), [(REFUSED, "the disk is full"), (ENDED, "the command has ended")])
def test_refused_changes_are_not_reported_as_saved(answer: str, text: str, page: Page) -> None:
    page.mark_true(0)
    page.window.run(f"window.asked = window.fetch; window.fetch = async () => {answer}")
    page.window.press("#undo")
    page.window.wait("document.body.dataset.state === 'failed'", "a refusal")
    assert f"not saved: {text}" in page.window.run("return document.getElementById('status').textContent")
    for button in ("#close", "#write"):
        page.window.press(button)
        page.window.wait("document.getElementById('status').className === 'bad'", "a refusal once more")
        assert page.window.run("return document.body.dataset.state") == "failed" and not page.server.is_finished
    page.window.run("window.fetch = window.asked")
    page.window.press("#close")
    page.window.wait("document.body.dataset.state === 'closed'", "the end")
    assert [len(places) for places in page.document()["corners"]] == [1, 1, 1, 0]


def test_hidden_corners_are_skipped(page: Page) -> None:
    for view, hidden in ((0, 1), (1, 3), (2, 0)):
        corners: list = list(true_corners(view))
        corners[hidden] = None
        page.mark(view, corners)
    marked = [sorted(places) for places in page.document()["corners"]]
    assert marked == [["0.png", "1.png"], ["1.png", "2.png"], ["0.png", "1.png", "2.png"], ["0.png", "2.png"]]
    page.show(3)
    assert is_blue(page.color_at(tuple(true_corners(3).mean(axis=0))))
    page.mark_edges(4, [None, None, true_corners(4)[[2, 3]]])
    assert [sorted(places) for places in page.document()["edges"]] == [[], [], ["4.png"], []]


def test_the_page_asks_for_nothing_from_elsewhere(page: Page) -> None:
    page.mark_true(0)
    names = page.window.run("return performance.getEntriesByType('resource').map((one) => one.name)")
    assert names and all(name.startswith(page.server.address.split("/?")[0]) for name in names)


def test_done_ends_the_command(page: Page) -> None:
    for view in range(3):
        page.mark_true(view)
    page.window.press("#close")
    page.window.wait("document.body.dataset.state === 'closed'", "the end")
    assert page.server.is_finished
    for key in ("Enter", "Tab", "a", "0", "Right", "]"):
        page.window.keys(key)
    page.window.evaluate("new Promise((next) => setTimeout(next, 300))")
    assert complaints(page) == []
    text = "const text = document.createRange(); text.selectNodeContents(document.body.firstElementChild);"
    assert page.window.run(f"{text} return text.getBoundingClientRect().height") < 30  # One line.


def test_marks_of_two_tabs_are_merged(page: Page) -> None:
    page.mark_true(0)
    saved(page.server.session, marked_document(material="mirror"))
    page.show(1)
    page.window.run(  # Otherwise the first corner may be saved before the last one is clicked.
        "window.asked = window.fetch; const whole = new Promise((go) => { window.release = go; });"
        "window.fetch = async (...request) => { await whole; return window.asked(...request); };"
    )
    for place in page.on_screen(true_corners(1)):
        page.window.click(*place)
    page.window.run("window.release()")
    page.window.wait("document.querySelectorAll('#panes .pane').length === 2", "both panes")
    page.saved()
    assert "pane 1 changed" in page.window.run("return document.getElementById('elsewhere').textContent")
    both = json.loads((page.root / "annotations.json").read_text())["panes"]
    assert [(pane["label"], pane["material"]) for pane in both] == [(1, "mirror"), (2, "glass")]
    assert all(len(places) == 2 for places in both[1]["corners"])
    page.window.keys("Control", "z")
    page.saved()
    assert json.loads((page.root / "annotations.json").read_text())["panes"] == both
    page.window.keys("a")
    page.window.press("#undo")  # Later changes can be undone.
    page.saved()
    assert json.loads((page.root / "annotations.json").read_text())["panes"] == both
