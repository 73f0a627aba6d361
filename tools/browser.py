"""A headless Chromium without a GPU, controlled like a user would: clicks, keys and screenshots.

Playwright drives it; Chromium itself is a Debian package (`make browser`).
"""

from __future__ import annotations

import io
import itertools
import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

STEPS = 5
"""Mouse moves between two points of a drag."""
OPTIONS = (
    "--disable-quic", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--proxy-server=127.0.0.1:9",
)  # fmt: skip
"""Command-line options of Chromium; the last one blocks all network access of pages."""
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PATIENCE = 60.0
"""Timeout in seconds of any action on the page, sufficient on a busy machine."""
LONGEST = 1000 * PATIENCE
"""The same in milliseconds, for Playwright."""
KEYS = {"Right": "ArrowRight", "Left": "ArrowLeft", "Up": "ArrowUp", "Down": "ArrowDown"}


def wait_until(holds: Callable[[], Any], what: str) -> Any:
    """Polls `holds`, and returns its first true value.

    Raises:
        AssertionError: the timeout has passed.
    """
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if found := holds():
            return found
        time.sleep(0.05)
    raise AssertionError(f"timed out after {PATIENCE:.0f} s waiting for {what}")


@contextmanager
def running_chromium() -> Iterator[Any]:
    """Chromium and Playwright, one pair per thread: started for the first user, stopped after the last."""
    from playwright.sync_api import sync_playwright

    if not _running:
        driver = sync_playwright().start()
        try:
            _running.append((driver, driver.chromium.launch(executable_path=CHROMIUM, args=OPTIONS, timeout=LONGEST)))
        except BaseException:
            driver.stop()
            raise
    else:
        _running.append(_running[-1])
    try:
        yield _running[-1][1]
    finally:
        driver, chromium = _running.pop()
        if not _running:
            chromium.close()
            driver.stop()


_running: list[tuple[Any, Any]] = []
"""The running pair, once for each of its users."""


class Browser:
    """One isolated tab; use it in a `with` statement."""

    def __init__(
        self, page: Path | str = "about:blank", width: int = 640, height: int = 480, *, query: str = "#still"
    ) -> None:
        """Opens a page from a file, with `query` appended to its address, or from an address."""
        self._requests: list[str] = []
        self._complaints: list[str] = []
        with ExitStack() as ending:
            chromium = ending.enter_context(running_chromium())
            self._tab = chromium.new_page(viewport={"width": width, "height": height})
            ending.callback(self._tab.close)
            self._tab.set_default_timeout(LONGEST)
            self._tab.on("request", lambda request: self._requests.append(request.url))
            self._tab.on("pageerror", lambda error: self._complaints.append(str(error)))
            self._tab.on("console", lambda said: said.type == "error" and self._complaints.append(said.text))
            self._tab.on("dialog", lambda asked: asked.accept())  # Such as the question whether to leave the page.
            self.open(page if isinstance(page, str) else page.resolve().as_uri() + query)
            self._ending = ending.pop_all()

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *unused: object) -> None:
        self._ending.close()

    def open(self, address: str) -> None:
        """Opens an address, and waits until the page is loaded."""
        if self._tab.goto(address) is None and address != "about:blank":
            self._tab.reload()  # A change of the fragment alone does not reload the page.
        if address.startswith("http") and "?" in address:
            self._tab.wait_for_url(lambda at: "?" not in at)  # A link with a key redirects to the page.

    def prefer(self, **media: Any) -> None:
        """Reloads the page with media preferences, such as `reduced_motion="reduce"`."""
        self._tab.emulate_media(**media)
        self._tab.reload()

    def evaluate(self, expression: str) -> Any:
        """Evaluates and awaits an expression; raises RuntimeError with the exception of the page."""
        from playwright.sync_api import Error

        try:
            return self._tab.evaluate(f"(async () => ({expression}))()")
        except Error as error:
            raise RuntimeError(error.message) from error

    def run(self, script: str, *arguments: Any) -> Any:
        """Runs a function body in the page, and returns its value."""
        return self.evaluate(f"(function () {{ {script} }}).apply(null, {json.dumps(arguments)})")

    def wait(self, expression: str, what: str) -> Any:
        """Waits until an expression is true in the page."""
        return wait_until(lambda: self.evaluate(expression), what)

    def screenshot(self) -> bytes:
        """Screenshot of the window, as PNG."""
        return self._tab.screenshot()

    def picture(self) -> np.ndarray:
        """Screenshot of the window, [H, W, 3] uint8."""
        return np.array(Image.open(io.BytesIO(self.screenshot())).convert("RGB"))

    def keys(self, *names: str) -> None:
        """Presses keys together, each given by its letter or name."""
        self._tab.keyboard.press("+".join(KEYS.get(name, name) for name in names))

    def press(self, selector: str) -> None:
        """Clicks an element by its CSS selector."""
        self._tab.locator(selector).first.click()

    def click(self, x: float, y: float, *, times: int = 1) -> None:
        """Clicks at a position in the window."""
        self._tab.mouse.click(x, y, click_count=times)

    def drag(self, path: Sequence[tuple[float, float]], *, pause: float = 0) -> None:
        """Presses at the first position, moves through the others with pauses in seconds, and releases at the last."""
        mouse = self._tab.mouse
        mouse.move(*path[0])
        mouse.down()
        for (x, y), (to_x, to_y) in itertools.pairwise(path):
            for step in range(1, STEPS + 1):
                share = step / STEPS
                mouse.move(x + (to_x - x) * share, y + (to_y - y) * share)
                time.sleep(pause)
        mouse.up()

    def requests(self) -> list[str]:
        """All addresses that the page requested."""
        return self._requests

    def complaints(self) -> list[str]:
        """Errors that the page reported."""
        return self._complaints
