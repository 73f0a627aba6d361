"""Makes the screenshots of docs/tutorial.md, docs/capture.md and docs/looking.md from synthetic scenes.

    python -m tools.make_capture_pictures --scene SCENE --capture CAPTURE --run RUN --busy BUSY --output docs/images

`--scene` has ground truth of its panes (`gt/planes.json`), which gives the corners to click in `glassplat annotate`.
`--capture` was made by `glassplat prepare`, and its report is shown; `--run` has an overview written by `glassplat
eval`, and its scene is shown in `glassplat view`. `--busy` is a scene of `tools.make_pane_scene --passers-by`, of which
a photograph is shown next to its masks. Images of options that are not given stay unchanged.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

import glassplat
from glassplat.access import LOCALHOST
from glassplat.cli.serving import photograph_readers
from glassplat.model.model import viewer_state
from glassplat.prepare.preparation import PAGE
from glassplat.scene.camera import NumpyCamera
from glassplat.viewer.render_loop import vacant_port
from glassplat.viewer.server import Viewer
from tools.browser import Browser, wait_until
from tools.marking_page import MarkingPage, marking_page

SIZE = (1180, 700)
PAGE_SIZE = (1180, 860)
VIEWER_SIZE = (1100, 740)
PAGE_QUALITY = 82
SETTLED = 3.0
"""Seconds after which the viewer has drawn what was asked."""
COLORS = 128
GAP, CAPTION = 8, 22
"""Gap between tiles, and height of their captions, pixels."""
APART = 4
"""Stride between the marked photographs, among those that show the whole pane."""


def true_corners(scene: Path) -> NDArray[np.float64]:
    """Corners [4, 3] of the first pane of the scene, in order around it."""
    plane = json.loads((scene / "gt" / "planes.json").read_text())[0]
    center, u, v = (np.array(plane[key]) for key in ("center", "half_u", "half_v"))
    return np.stack([center - u + v, center + u + v, center + u - v, center - u - v])


def whole_views(cameras: Sequence[NumpyCamera], corners: NDArray[np.float64]) -> list[int]:
    """Indices of views that show the whole pane; corners may lie slightly outside the photograph."""
    return [number for number, camera in enumerate(cameras) if camera.contains(corners, 0.2).all()]


def save(page: MarkingPage, path: Path) -> None:
    """Saves a screenshot with few colours, to keep the repository small."""
    picture = Image.fromarray(page.window.picture())
    picture.quantize(COLORS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(path)


def draw_page(page: Path, picture: Path) -> None:
    """Saves a screenshot of the top of a page on disk."""
    with Browser(page, *PAGE_SIZE, query="") as window:
        window.run("for (const one of document.images) one.loading = 'eager'")
        window.wait("[...document.images].every(one => one.complete)", "the pictures of the page")
        Image.fromarray(window.picture()).convert("RGB").save(picture, quality=PAGE_QUALITY, optimize=True)
    print(picture)


def draw(scene: Path, output: Path) -> None:
    """Marks the pane in a copy of the scene, and saves two screenshots on the way."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / scene.name
        shutil.copytree(scene, copy, ignore=shutil.ignore_patterns("panes", "masks", "planes.json", "annot*", "gt"))
        with marking_page(copy, width=SIZE[0], height=SIZE[1]) as page:
            cameras, corners = page.server.session.cameras, true_corners(scene)
            first, second, third = whole_views(cameras, corners)[:: APART + 1][:3]
            page.mark(first, cameras[first].project(corners))
            page.show(second)
            save(page, output / "annotate-second.png")
            page.mark(second, cameras[second].project(corners))
            page.mark(third, cameras[third].project(corners))
            left = cameras[third].project(corners)
            post = 0.62 * left[[0, 1, 2, 3]] + 0.38 * left[[1, 0, 3, 2]]
            page.cut(third, np.stack([post[0], post[1], post[2], post[3]]))
            save(page, output / "annotate-cut.png")


def draw_viewer(run: Path, output: Path) -> None:
    """Saves the viewer of a run; then a pane that can be moved, next to the layer *error*."""
    state = viewer_state(glassplat.load(run), photograph_readers(run))
    viewer = Viewer(state, LOCALHOST, vacant_port(LOCALHOST))
    viewer.start()
    try:
        with Browser(viewer.address, *VIEWER_SIZE) as window:
            (client,) = wait_until(lambda: tuple(viewer._clients.values()), "the browser to connect")
            window.wait("document.body.innerText.includes('Nearest photograph')", "the controls")
            window.press(".mantine-Notification-closeButton")  # Says that the browser has no GPU.
            pictures = []
            for control, value in ((client._layer, "rgb"), (client._panes._chosen, "1"), (client._layer, "error")):
                control.value = value
                time.sleep(SETTLED)
                pictures.append(Image.fromarray(window.picture()))
    finally:
        viewer.stop()
    pictures[0].save(output / "view.jpg", quality=PAGE_QUALITY, optimize=True)
    width, height = VIEWER_SIZE[0] * 2 // 3, VIEWER_SIZE[1] * 2 // 3
    sheet = Image.new("RGB", (2 * width + GAP, height), "white")
    for place, picture in enumerate(pictures[1:]):
        sheet.paste(picture.resize((width, height), Image.Resampling.LANCZOS), (place * (width + GAP), 0))
    sheet.save(output / "view_edit.jpg", quality=PAGE_QUALITY, optimize=True)
    print(output / "view.jpg", output / "view_edit.jpg")


def draw_masks(scene: Path, picture: Path) -> None:
    """Saves a photograph with a passer-by, next to its pane mask and its mask of ignored pixels."""
    somebody = {path.name: np.array(Image.open(path)) > 0 for path in sorted((scene / "gt/passers_by").iterdir())}
    name = max((scene / "panes").iterdir(), key=lambda path: somebody.get(path.name, np.zeros(1)).sum()).name
    tiles = {
        f"images/{name}": Image.open(scene / "images" / name),
        f"panes/{name} (label 1)": Image.fromarray(
            (np.array(Image.open(scene / "panes" / name)) > 0).astype("u1") * 255
        ),
        f"masks/{name}": Image.fromarray(np.where(somebody[name], 0, 255).astype(np.uint8)),
    }
    width, height = tiles[f"images/{name}"].size
    sheet = Image.new("RGB", (3 * width + 2 * GAP, height + CAPTION), "white")
    for place, (caption, tile) in enumerate(tiles.items()):
        left = place * (width + GAP)
        sheet.paste(tile.convert("RGB"), (left, CAPTION))
        ImageDraw.Draw(sheet).rectangle((left, CAPTION, left + width - 1, CAPTION + height - 1), outline="grey")
        ImageDraw.Draw(sheet).text((left, 2), caption, fill="black", font_size=CAPTION - 6)
    sheet.save(picture, quality=PAGE_QUALITY, optimize=True)
    print(picture)


def main() -> None:
    """Parses the arguments and makes the screenshots."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--busy", type=Path)
    parser.add_argument("--output", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    if options.scene:
        draw(options.scene, options.output)
    if options.capture:
        draw_page(options.capture / PAGE, options.output / "tutorial-prepare.jpg")
    if options.run:
        draw_page(options.run / "index.html", options.output / "tutorial-eval.jpg")
        draw_viewer(options.run, options.output)
    if options.busy:
        draw_masks(options.busy, options.output / "masks.jpg")


if __name__ == "__main__":
    main()
