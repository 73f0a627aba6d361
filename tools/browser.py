"""A headless Chromium that is driven like a person drives it: clicks, keys, and pictures of what it shows.

It is spoken to in the W3C's WebDriver protocol, which chromedriver serves; both are Debian packages (`make browser`).
"""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage",
    "--force-device-scale-factor=1", "--hide-scrollbars",
)  # fmt: skip
PATIENCE = 60.0
"""Seconds that anything on the page may take, on a machine that does much else."""
KEYS = {
    "Enter": "\ue007",
    "Escape": "\ue00c",
    "Right": "\ue014",
    "Left": "\ue012",
    "Control": "\ue009",
    "Tab": "\ue004",
}


class Browser:
    """One window."""

    def __init__(self, driver: str, session: str) -> None:
        self._base = f"{driver}/session/{session}"

    def ask(self, path: str, body: Any = None) -> Any:
        """One command of the protocol; its value."""
        return _ask(f"{self._base}{path}", body)

    def open(self, address: str) -> None:
        """Goes to an address."""
        self.ask("/url", {"url": address})

    def run(self, script: str, *arguments: Any) -> Any:
        """The value of a function body in the page."""
        return self.ask("/execute/sync", {"script": script, "args": list(arguments)})

    def wait(self, script: str, what: str) -> Any:
        """Waits until an expression is true in the page."""
        return wait_until(lambda: self.run(f"return {script}"), what)

    def click(self, x: float, y: float, *, times: int = 1) -> None:
        """Clicks at a place of the window."""
        press = [{"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}] * times
        self._pointer([_move(x, y), *press])

    def drag(self, path: Sequence[tuple[float, float]]) -> None:
        """Presses at the first place, moves through the others and lets go at the last."""
        ways = [_move(x, y, 30) for x, y in path[1:]]
        down, up = ({"type": kind, "button": 0} for kind in ("pointerDown", "pointerUp"))
        self._pointer([_move(*path[0]), down, *ways, up])

    def keys(self, *names: str) -> None:
        """Presses keys together, by their letter or name."""
        codes = [KEYS.get(name, name) for name in names]
        down = [{"type": "keyDown", "value": code} for code in codes]
        up = [{"type": "keyUp", "value": code} for code in reversed(codes)]
        self.ask("/actions", {"actions": [{"type": "key", "id": "keyboard", "actions": down + up}]})

    def press(self, selector: str) -> None:
        """Clicks an element by its CSS selector."""
        found = self.ask("/element", {"using": "css selector", "value": selector})
        self.ask(f"/element/{next(iter(found.values()))}/click", {})

    def picture(self) -> np.ndarray:
        """[H, W, 3] uint8, what the window shows."""
        return np.array(Image.open(io.BytesIO(base64.b64decode(self.ask("/screenshot")))).convert("RGB"))

    def _pointer(self, actions: list[dict]) -> None:
        pointer = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": actions}
        self.ask("/actions", {"actions": [pointer]})


def _move(x: float, y: float, duration: int = 0) -> dict:
    return {"type": "pointerMove", "x": round(x), "y": round(y), "duration": duration, "origin": "viewport"}


def _ask(address: str, body: Any = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(address, data=data, headers={"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as response:
            return json.load(response)["value"]
    except urllib.error.HTTPError as error:
        with error:
            raise AssertionError(json.load(error)["value"]["message"]) from error


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
def browser(width: int = 1400, height: int = 900) -> Iterator[Browser]:
    """A window of its own profile, closed at the end."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile, _driver() as driver:
        arguments = [*FLAGS, f"--window-size={width},{height}", f"--user-data-dir={profile}"]
        options = {"goog:chromeOptions": {"args": arguments, "binary": CHROMIUM}}
        session = _ask(f"{driver}/session", {"capabilities": {"alwaysMatch": options}})["sessionId"]
        window = Browser(driver, session)
        try:
            yield window
        finally:
            request = urllib.request.Request(f"{driver}/session/{session}", method="DELETE")
            urllib.request.urlopen(request, timeout=PATIENCE).close()


@contextmanager
def _driver() -> Iterator[str]:
    assert DRIVER is not None
    process = subprocess.Popen([DRIVER, "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if found := re.search(r"started successfully on port (\d+)", line):
                yield f"http://127.0.0.1:{found.group(1)}"
                return
        raise AssertionError("chromedriver said no port")
    finally:
        process.terminate()
        process.wait(timeout=PATIENCE)
        if process.stdout is not None:
            process.stdout.close()
