"""A headless Chromium without a GPU, used as a person uses it: clicks, keys, and pictures of what it shows.

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
"""Moves of the mouse from one place of a drag to the next."""
OPTIONS = (
    "--disable-quic", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--proxy-server=127.0.0.1:9",
)  # fmt: skip
"""The last one sends whatever a page would load from anywhere into the void."""
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PATIENCE = 60.0
"""Seconds that anything on the page may take, on a machine that does much else."""
LONGEST = 1000 * PATIENCE
"""The same in Playwright's milliseconds."""
KEYS = {"Right": "ArrowRight", "Left": "ArrowLeft", "Up": "ArrowUp", "Down": "ArrowDown"}


def wait_until(holds: Callable[[], Any], what: str) -> Any:
    """The first value that is true.

    Raises:
        AssertionError: it takes too long.
    """
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if found := holds():
            return found
        time.sleep(0.05)
    raise AssertionError(f"waited {PATIENCE:.0f} s in vain for {what}")


@contextmanager
def running_chromium() -> Iterator[Any]:
    """Chromium and Playwright, which a thread can have only once: begun for the first who asks, ended with the last."""
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
"""The same two, for each who uses them."""


class Browser:
    """One tab, apart from all others; use it in a `with` statement."""

    def __init__(
        self, page: Path | str = "about:blank", width: int = 640, height: int = 480, *, query: str = "#still"
    ) -> None:
        """Opens a page from its file, with what stands behind its address, or from its address."""
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
            self._tab.on("dialog", lambda asked: asked.accept())  # As when a page asks whether to leave it.
            self.open(page if isinstance(page, str) else page.resolve().as_uri() + query)
            self._ending = ending.pop_all()

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *unused: object) -> None:
        self._ending.close()

    def open(self, address: str) -> None:
        """Goes to an address, and waits until it is loaded."""
        if self._tab.goto(address) is None and address != "about:blank":
            self._tab.reload()  # The same page at another place in it is not loaded again by itself.
        if address.startswith("http") and "?" in address:
            self._tab.wait_for_url(lambda at: "?" not in at)  # A link with a key in it leads on to the page.

    def prefer(self, **media: Any) -> None:
        """Loads the page again for a person with preferences, such as `reduced_motion="reduce"`."""
        self._tab.emulate_media(**media)
        self._tab.reload()

    def evaluate(self, expression: str) -> Any:
        """The value of an expression, awaited; raises RuntimeError with what the page threw."""
        from playwright.sync_api import Error

        try:
            return self._tab.evaluate(f"(async () => ({expression}))()")
        except Error as error:
            raise RuntimeError(error.message) from error

    def run(self, script: str, *arguments: Any) -> Any:
        """The value of a function body in the page."""
        return self.evaluate(f"(function () {{ {script} }}).apply(null, {json.dumps(arguments)})")

    def wait(self, expression: str, what: str) -> Any:
        """Waits until an expression is true in the page."""
        return wait_until(lambda: self.evaluate(expression), what)

    def screenshot(self) -> bytes:
        """Picture of the window, as PNG."""
        return self._tab.screenshot()

    def picture(self) -> np.ndarray:
        """[H, W, 3] uint8, what the window shows."""
        return np.array(Image.open(io.BytesIO(self.screenshot())).convert("RGB"))

    def keys(self, *names: str) -> None:
        """Presses keys together, by their letter or name."""
        self._tab.keyboard.press("+".join(KEYS.get(name, name) for name in names))

    def press(self, selector: str) -> None:
        """Clicks an element by its CSS selector."""
        self._tab.locator(selector).first.click()

    def click(self, x: float, y: float, *, times: int = 1) -> None:
        """Clicks at a place of the window."""
        self._tab.mouse.click(x, y, click_count=times)

    def drag(self, path: Sequence[tuple[float, float]], *, pause: float = 0) -> None:
        """Presses at the first place, moves through the others with pauses of seconds, and lets go at the last."""
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
        """Every address that the page asked for."""
        return self._requests

    def complaints(self) -> list[str]:
        """Errors that the page reported."""
        return self._complaints
