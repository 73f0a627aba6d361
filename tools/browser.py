"""A headless Chromium without a GPU that is driven as a person drives it: clicks, keys, and pictures of what it shows.

It is spoken to over a pipe, in the protocol of its developer tools; it is a Debian package (`make browser`).
"""

from __future__ import annotations

import base64
import io
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

STEPS = 5
"""Moves of the mouse from one place of a drag to the next."""
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-extensions", "--disable-dev-shm-usage",
    "--hide-scrollbars", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--remote-debugging-pipe",
    "--force-color-profile=srgb", "--proxy-server=127.0.0.1:9",
)  # fmt: skip
"""The last one sends whatever a page would load from anywhere into the void."""
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PATIENCE = 60.0
"""Seconds that anything on the page may take, on a machine that does much else."""
KEYS = {"Right": "ArrowRight", "Left": "ArrowLeft", "Up": "ArrowUp", "Down": "ArrowDown"}
MODIFIERS = {"Alt": 1, "Control": 2, "Meta": 4, "Shift": 8}
CODES = {"Enter": 13, "Escape": 27, "Tab": 9, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}
"""What Windows calls the keys that are no letters; Chromium tells by it what a key does."""


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


class Browser:
    """One tab of one browser; use it in a `with` statement."""

    def __init__(
        self, page: Path | str = "about:blank", width: int = 640, height: int = 480, *, query: str = "#still"
    ) -> None:
        """Opens a page from its file, with what stands behind its address, or from its address."""
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        (to_read, self._to_write), (self._from_read, from_write) = os.pipe(), os.pipe()
        # The browser reads its third descriptor and writes its fourth; a shell moves them there.
        command = [
            str(CHROMIUM),
            *OPTIONS,
            f"--window-size={width},{height}",
            f"--user-data-dir={self._profile.name}",
        ]
        shell = f'exec "$@" 3<&{to_read} 4>&{from_write}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "bash", *command, "about:blank"],
            pass_fds=(to_read, from_write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(from_write)
        self._buffer, self._number, self.events = b"", 0, []
        targets = self._ask("Target.getTargets")["targetInfos"]
        tab = next(target["targetId"] for target in targets if target["type"] == "page")
        self._session = None
        self._session = self._ask("Target.attachToTarget", targetId=tab, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self._ask(f"{domain}.enable")
        self._ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.open(page if isinstance(page, str) else page.resolve().as_uri() + query)

    _session: str | None = None

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *unused: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._to_write)
        os.close(self._from_read)
        self._profile.cleanup()

    def open(self, address: str) -> None:
        """Goes to an address, and waits until it is loaded."""
        begun = len(self.events)
        if "loaderId" not in self._ask("Page.navigate", url=address):
            self._ask("Page.reload")  # The same page at another place in it is not loaded again by itself.
        while not any(event.get("method") == "Page.loadEventFired" for event in self.events[begun:]):
            self.events.append(self._next())
        if address.startswith("http") and "?" in address:
            wait_until(self._is_past_the_key, "the page behind a link with a key")

    def _is_past_the_key(self) -> bool:
        """Return whether a link with a key in it has led on to the page."""
        try:
            return bool(self.evaluate("location.search === '' && document.readyState === 'complete'"))
        except RuntimeError:  # It is being left.
            return False

    def evaluate(self, expression: str) -> Any:
        """The value of an expression, awaited; raises RuntimeError with what the page threw."""
        answer = self._ask("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise RuntimeError(details.get("exception", {}).get("description", details["text"]))
        return answer["result"].get("value")

    def run(self, script: str, *arguments: Any) -> Any:
        """The value of a function body in the page."""
        return self.evaluate(f"(function () {{ {script} }}).apply(null, {json.dumps(arguments)})")

    def wait(self, expression: str, what: str) -> Any:
        """Waits until an expression is true in the page."""
        return wait_until(lambda: self.evaluate(expression), what)

    def screenshot(self) -> bytes:
        """Picture of the window, as PNG."""
        return base64.b64decode(self._ask("Page.captureScreenshot", format="png")["data"])

    def picture(self) -> np.ndarray:
        """[H, W, 3] uint8, what the window shows."""
        return np.array(Image.open(io.BytesIO(self.screenshot())).convert("RGB"))

    def keys(self, *names: str) -> None:
        """Presses keys together, by their letter or name."""
        keys = [KEYS.get(name, name) for name in names]
        held = sum(MODIFIERS.get(key, 0) for key in keys)
        for key in keys:
            typed = {"text": "\r" if key == "Enter" else key} if not held and (len(key) == 1 or key == "Enter") else {}
            self._ask("Input.dispatchKeyEvent", type="keyDown", **typed, **_key(key, held))
        for key in reversed(keys):
            self._ask("Input.dispatchKeyEvent", type="keyUp", **_key(key, held))

    def press(self, selector: str) -> None:
        """Clicks an element by its CSS selector."""
        x, y = self.run(
            "const one = document.querySelector(arguments[0]); one.scrollIntoView({ block: 'nearest' });"
            "const box = one.getBoundingClientRect(); return [box.left + box.width / 2, box.top + box.height / 2]",
            selector,
        )
        self.click(x, y)

    def click(self, x: float, y: float, *, times: int = 1) -> None:
        """Clicks at a place of the window."""
        self._mouse("mouseMoved", x, y)
        for count in range(1, times + 1):
            self._mouse("mousePressed", x, y, button="left", clickCount=count)
            self._mouse("mouseReleased", x, y, button="left", clickCount=count)

    @property
    def process(self) -> int:
        """The number of the process that it runs in, with all its children."""
        return self._process.pid

    def drag(self, path: Sequence[tuple[float, float]], *, pause: float = 0) -> None:
        """Presses at the first place, moves through the others with pauses of seconds, and lets go at the last."""
        self._mouse("mouseMoved", *path[0])
        self._mouse("mousePressed", *path[0], button="left", clickCount=1)
        for (x, y), (to_x, to_y) in itertools.pairwise(path):
            for step in range(1, STEPS + 1):
                share = step / STEPS
                self._mouse("mouseMoved", x + (to_x - x) * share, y + (to_y - y) * share, button="left", buttons=1)
                time.sleep(pause)
        self._mouse("mouseReleased", *path[-1], button="left", clickCount=1)

    def _mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self._ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def requests(self) -> list[str]:
        """Every address that the page asked for."""
        sent = (event["params"] for event in self.events if event.get("method") == "Network.requestWillBeSent")
        return [params["request"]["url"] for params in sent]

    def complaints(self) -> list[str]:
        """Errors that the page reported."""
        found = []
        for event in self.events:
            if event.get("method") == "Runtime.exceptionThrown":
                found.append(str(event["params"]["exceptionDetails"]))
            if event.get("method") == "Log.entryAdded" and event["params"]["entry"]["level"] == "error":
                found.append(event["params"]["entry"]["text"])
        return found

    def _ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = self._send(method, parameters)
        while True:
            answer = self._next()
            if answer.get("method") == "Page.javascriptDialogOpening":  # As when a page asks whether to leave it.
                self._send("Page.handleJavaScriptDialog", {"accept": True})
            if answer.get("id") != number:
                self.events.append(answer)
            elif "error" in answer:
                raise RuntimeError(f"{method}: {answer['error']['message']}")
            else:
                result: dict[str, Any] = answer["result"]
                return result

    def _send(self, method: str, parameters: dict[str, Any]) -> int:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to_write, json.dumps(message).encode() + b"\0")
        return self._number

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            chunk = os.read(self._from_read, 1 << 20)
            if not chunk:
                raise RuntimeError("the browser has ended")
            self._buffer += chunk
        message, _, self._buffer = self._buffer.partition(b"\0")
        answer: dict[str, Any] = json.loads(message)
        return answer


def _key(key: str, held: int) -> dict[str, Any]:
    """Codes by which Chromium knows a key."""
    code = CODES.get(key, ord(key.upper()) if len(key) == 1 else 0)
    return {"key": key, "modifiers": held, "windowsVirtualKeyCode": code}
