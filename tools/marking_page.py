"""Marks panes of a capture on the page of `glassplat annotate` in a headless browser, as a user would with a mouse.

    python -m tools.marking_page CAPTURE MARKS.json --pictures FOLDER

MARKS.json maps names of photographs to the clicked points, in pixels of the undistorted photograph:

    {"frame_0003.jpg": {"corners": [[120, 80], [900, 60], null, [110, 520]],
                        "edges": [null, [[905, 300], [908, 500]], null, null],
                        "cut": [[[300, 400], ...]]}, ...}

Corners and edges that are null are not visible in that photograph, and are skipped.

Masks and planes are written at the end; `--pictures` also saves screenshots on the way.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from PIL import Image

from glassplat.annotate.server import AnnotationServer
from glassplat.annotate.session import open_session
from tools.browser import Browser

Places = Sequence[Any] | np.ndarray
WHOLE = 1.5
"""Initial extent of the canvas in units of the photograph size, which leaves room for corners outside of it."""


class MarkingPage:
    """The page in a browser."""

    def __init__(self, window: Browser, server: AnnotationServer) -> None:
        self.window, self.server = window, server
        self._view = 0

    def open(self) -> None:
        """Opens or reopens the page."""
        self.window.open(self.server.address)
        self.window.wait("document.body.dataset.ready === 'yes'", "the page")
        self.saved()

    def saved(self) -> None:
        """Waits until all marks are saved on the server."""
        self.window.wait("['saved', undefined].includes(document.body.dataset.state)", "the document to be saved")

    def show(self, view: int) -> None:
        """Shows a photograph, given by its index."""
        self.window.run("document.querySelectorAll('#views button')[arguments[0]].click()", view)
        self.window.wait(f"document.body.dataset.view === '{view}'", f"photograph {view}")
        self._view = view

    def on_screen(self, places: Places) -> list[tuple[float, float]]:
        """Window positions of points in the photograph, at the initial zoom."""
        left, top, width, height = self.window.run(
            "const box = document.getElementById('canvas').getBoundingClientRect();"
            "return [box.left, box.top, box.width, box.height]"
        )
        camera = self.server.session.views[self._view].camera
        scale = min(width / (camera.width * WHOLE), height / (camera.height * WHOLE))
        x, y = left + (width - camera.width * scale) / 2, top + (height - camera.height * scale) / 2
        return [(x + scale * float(place[0]), y + scale * float(place[1])) for place in places]

    def mark(self, view: int, corners: Places) -> None:
        """Clicks corners in order; None skips one."""
        self.show(view)
        self.window.keys("1")
        for corner in corners:
            if corner is None:
                self.window.keys("n")
            else:
                self.window.click(*self.on_screen([corner])[0])
        self.saved()

    def mark_edges(self, view: int, edges: Sequence[Places | None]) -> None:
        """Draws along edges in order; None skips one."""
        self.show(view)
        self.window.keys("2")
        for ends in edges:
            if ends is None:
                self.window.keys("n")
            else:
                self.window.drag(self.on_screen(ends))
        self.window.keys("1")
        self.saved()

    def cut(self, view: int, outline: Places) -> None:
        """Cuts out a polygon."""
        self.show(view)
        self.window.keys("3")
        for x, y in self.on_screen(outline):
            self.window.click(x, y)
        self.window.keys("Enter")
        self.window.keys("1")
        self.saved()

    def write(self) -> str:
        """Writes masks and planes; returns the message of the page."""
        self.window.press("#write")
        self.window.wait("document.body.dataset.written", "masks and planes")
        return str(self.window.run("return document.getElementById('status').textContent"))

    def said(self) -> str:
        """Status text next to the panes."""
        return str(self.window.run("return document.getElementById('panes').innerText"))


@contextmanager
def marking_page(capture: Path, *, width: int = 1400, height: int = 900) -> Iterator[MarkingPage]:
    """The page of a capture in a browser."""
    with AnnotationServer(open_session(capture), 0) as server:
        thread = Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            with Browser(width=width, height=height) as window:
                page = MarkingPage(window, server)
                page.open()
                yield page
        finally:
            server.shutdown()
            thread.join()


def mark_all(page: MarkingPage, marks: Mapping[str, Any], pictures: Path | None) -> None:
    """Marks everything from a file of marks, photograph by photograph."""
    numbers = {view.name: number for number, view in enumerate(page.server.session.views)}
    for done, (name, what) in enumerate(marks.items(), start=1):
        page.mark(numbers[name], what.get("corners", []))
        page.mark_edges(numbers[name], what.get("edges", []))
        for outline in what.get("cut", []):
            page.cut(numbers[name], outline)
        _save(page, pictures, f"{done}-{Path(name).stem}")
        print(f"{name}: {page.said()}")


def _save(page: MarkingPage, pictures: Path | None, name: str) -> None:
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        Image.fromarray(page.window.picture()).save(pictures / f"{name}.png")


def main() -> None:
    """Marks the panes, writes masks and planes, and prints the message of the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("marks", type=Path)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    with marking_page(options.capture) as page:
        mark_all(page, json.loads(options.marks.read_text(encoding="utf-8")), options.pictures)
        print(page.write())


if __name__ == "__main__":
    main()
