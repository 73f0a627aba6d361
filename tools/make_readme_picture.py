"""The image of the README: the layers of one test view of a finished `planar` or `deferred` run.

python tools/make_readme_picture.py RUN --view 0016.jpg --output docs/images/window.png

`--output sway.json` writes cameras that sway around that view instead, for the animation:

glassplat video RUN --output wipe.webp --path keyframes --keyframes sway.json --layers rgb without_panes --layout wipe
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from glassplat.cli.runs import open_run
from glassplat.evaluate.evaluate import time_render
from glassplat.evaluate.metrics import quantize
from glassplat.evaluate.report import TITLE_HEIGHT, Panel, compose_sheet
from glassplat.files.images import write_image
from glassplat.render.layers import layer_image

PARTS = {
    "transmission": "behind the glass",
    "base": "its own colour",
    "reflection": "what it reflects",
    "normal": "normals",
}
CAPTION_SIZE = 26
"""Pixels; legible where a page shows four panels of 400 pixels next to each other."""


SWAY = (-0.35, 0.0, 0.35, 0.0, -0.35)
"""Offsets of the swaying camera along its horizontal axis, world units."""


def swaying(camera: dict[str, Any]) -> list[dict[str, Any]]:
    """Cameras to the left and right of one in `cameras.json` of a run, as keyframes of a video."""
    right = [row[0] for row in camera["rotation"]]
    places = [[p + shift * r for p, r in zip(camera["position"], right, strict=True)] for shift in SWAY]
    return [{**camera, "id": k, "img_name": f"{k}.png", "position": place} for k, place in enumerate(places)]


def main() -> None:
    """Renders the view and writes the image, or the cameras."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--view", required=True, help="name of a test view")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    if arguments.output.suffix == ".json":
        cameras = json.loads((arguments.run / "cameras.json").read_text(encoding="utf-8"))
        (camera,) = [camera for camera in cameras if camera["img_name"] == arguments.view]
        arguments.output.write_text(json.dumps(swaying(camera)), encoding="utf-8")
        return
    stored = open_run(arguments.run)
    view = next((v for v in stored.dataset.test if v.name == arguments.view), None)
    if view is None:
        raise SystemExit(f"no test view {arguments.view!r}; there are {[v.name for v in stored.dataset.test]}")
    frame, _ = time_render(stored.renderer, stored.scene, view)
    panels = [Panel("photograph", view.photo), Panel("render", quantize(frame.rgb))]
    for layer in (layer for layer in PARTS if layer in frame.layers):
        panels.append(Panel(PARTS[layer], quantize(layer_image(frame, layer))))
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    write_image(arguments.output, compose_sheet([panels], "", "", caption_size=CAPTION_SIZE)[TITLE_HEIGHT:])


if __name__ == "__main__":
    main()
