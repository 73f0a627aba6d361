"""The page in windows, frames and browsers of all kinds, and with the preferences of readers."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from glassplat.publish.web_page import page_text, read_asset, script_json, write_page
from glassplat.render.planar import Planar
from tests.browser_needed import needs_browser
from tests.publish.test_web_page import CAMERAS
from tests.training.tiny_capture import true_scene
from tools.browser import Browser

pytestmark = [needs_browser, pytest.mark.usefixtures("one_chromium")]


def test_every_control_can_be_reached_on_a_narrow_screen_until_all_are_hidden(tmp_path: Path) -> None:
    write_page(tmp_path / "index.html", true_scene(), Planar(), CAMERAS, "Narrow")
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        browser.wait("document.body.classList.contains('ready')", "the page")
        browser.evaluate("document.querySelector('[data-do=help]').click()")
        outside = """[...document.querySelectorAll('#dock button, #dock input, #help')].filter((one) => {
          const { left, top, right, bottom } = one.getBoundingClientRect();
          return Math.min(left, top) < 0 || right > innerWidth || bottom > innerHeight;
        }).map((one) => one.id || one.textContent)"""
        assert browser.evaluate(outside) == []
        look = "getComputedStyle(document.querySelector('nav'))"
        shown = f"{look}.visibility"
        browser.wait(f"{look}.opacity === '1'", "all controls")
        assert browser.evaluate(f"document.body.classList.add('bare'), {shown}") == "visible", "controls fade"
        browser.wait(f"{shown} === 'hidden'", "controls that no key reaches")


def test_a_window_wider_than_textures_shows_a_coarser_picture(tmp_path: Path) -> None:
    write_page(tmp_path / "index.html", true_scene(), Planar(), CAMERAS, "Wide")
    with Browser(tmp_path / "index.html", 8400, 100) as browser:
        browser.wait("document.body.classList.contains('ready')", "the page")
        canvas = "document.getElementById('view')"
        limit = browser.evaluate(f"{canvas}.getContext('webgl2').getParameter(0x0d33)")  # MAX_TEXTURE_SIZE
        assert browser.evaluate(f"{canvas}.width") == limit and browser.complaints() == []


LOSE = "document.getElementById('view').getContext('webgl2').getExtension('WEBGL_lose_context').loseContext();"
BEGIN = "await display.begin();"


@pytest.mark.parametrize(
    ("broken", "by", "message"),
    [
        ("body.classList.add('ready');", f"body.classList.add('ready'); {LOSE}", "load the page again"),
        (BEGIN, f"{LOSE} await new Promise((next) => setTimeout(next, 50)); {BEGIN}", "load the page again"),
        ("getContext('webgl2'", "getContext('none'", "no WebGL 2; try a current"),
        ("window.DecompressionStream", "window.nothing", "too old; try a current"),
    ],
)
def test_an_image_that_the_browser_cannot_show_is_reported(broken: str, by: str, message: str, tmp_path: Path) -> None:
    page = page_text(true_scene(), Planar(), CAMERAS, "Lost")
    assert page.count(broken) == 1
    (tmp_path / "index.html").write_text(page.replace(broken, by))
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        browser.wait("document.body.classList.contains('failed')", "a word about it")
        assert message in browser.evaluate("document.getElementById('message').textContent")


def test_preferences_of_the_reader_count(tmp_path: Path) -> None:
    write_page(tmp_path / "index.html", true_scene(), Planar(), CAMERAS, "Preferences")
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        browser.prefer(reduced_motion="reduce", forced_colors="active")
        color = "getComputedStyle(document.querySelector('[aria-pressed=PRESSED]')).backgroundColor"
        browser.wait("document.body.classList.contains('ready')", "the page")
        assert len({browser.evaluate(color.replace("PRESSED", pressed)) for pressed in ("true", "false")}) == 2
        flown = "navigation.flyTo(scene.views[1]); return [navigation.advance(0.02), navigation.advance(0.02)];"
        assert browser.evaluate(f"glassplat.then(({{ navigation, scene }}) => {{ {flown} }})") == [True, False]


def test_drags_and_keys_turn_the_view_towards_where_they_point(tmp_path: Path) -> None:
    """Things nearer than the point in view follow the pointer, as in `glassplat view`."""
    write_page(tmp_path / "index.html", true_scene(), Planar(), CAMERAS, "Turned")
    with Browser(tmp_path / "index.html", 320, 240) as browser:

        def turn(act: Callable[[], None]) -> np.ndarray:
            """[3] the line of sight after `act`, in camera axes from before it."""
            rotation = "glassplat.then(({ navigation }) => (navigation.still(), navigation.pose().rotation))"
            before = np.reshape(browser.evaluate(rotation), (3, 3))
            act()
            return before @ np.reshape(browser.evaluate(rotation), (3, 3))[2]

        browser.wait("document.body.classList.contains('ready')", "the page")
        for axis, end, keys in ((0, (180, 60), ("Left", "Right")), (1, (160, 80), ("Up", "Down"))):
            assert turn(lambda end=end: browser.drag([(160, 60), end]))[axis] > 0.05
            for sign, key in zip((-1, 1), keys, strict=True):
                assert sign * turn(lambda key=key: browser.keys("Shift", key))[axis] > 0.01


def test_the_controls_are_legible_over_a_white_scene() -> None:
    """The contrast of WCAG 2.2 for small text is 4.5."""

    def luminance(gray: float) -> float:
        return (gray / 255 / 12.92) if gray / 255 <= 0.04045 else ((gray / 255 + 0.055) / 1.055) ** 2.4

    def laid_over(name: str, below: float) -> float:
        (color,) = re.findall(rf"--{name}: rgba\(([^)]*)\)", read_asset("style.css"))
        red, green, blue, alpha = map(float, color.split(","))
        return alpha * (0.2126 * red + 0.7152 * green + 0.0722 * blue) + (1 - alpha) * below

    panel = laid_over("pane", 255)
    assert (luminance(laid_over("soft", panel)) + 0.05) / (luminance(panel) + 0.05) >= 4.5


def test_the_page_works_in_a_srcdoc_frame(tmp_path: Path) -> None:
    page = script_json(page_text(true_scene(), Planar(), CAMERAS, "Framed"))
    frame = "<iframe allow=\"fullscreen 'none'\"></iframe>"
    (tmp_path / "outer.html").write_text(f"{frame}<script>document.querySelector('iframe').srcdoc = {page}</script>")
    with Browser(tmp_path / "outer.html", 640, 480) as browser:
        framed = "document.querySelector('iframe').contentDocument"
        browser.wait(f"{framed}.body.classList.contains('ready')", "the page")
        assert browser.evaluate(f"{framed}.querySelector('[data-do=full]').hidden"), "the frame does not allow it"
        browser.run(f"{framed}.querySelector('[data-do=after]').click()")
        browser.wait(f"{framed}.location.href.startsWith('about:srcdoc#view=')", "the address")
        assert browser.evaluate(f"{framed}.body.classList.contains('ready')")
