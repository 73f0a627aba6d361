"""The README's picture: one test view of a finished `planar` or `deferred` run, taken apart.

python tools/make_readme_picture.py RUN --view 0016.jpg --output docs/images/showcase.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

from glassplat.cli.runs import open_run
from glassplat.evaluate.evaluate import timed_render
from glassplat.evaluate.metrics import quantized
from glassplat.evaluate.sheet import TITLE_HEIGHT, Panel, composed
from glassplat.files.images import write_image
from glassplat.render.layers import normal_colors

PARTS = {
    "transmission": "behind the glass",
    "base": "its own colour",
    "reflection": "what it reflects",
    "normal": "normals",
}


def main() -> None:
    """Renders the view and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--view", required=True, help="name of a test view")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    stored = open_run(arguments.run)
    view = next((v for v in stored.dataset.test if v.name == arguments.view), None)
    if view is None:
        raise SystemExit(f"no test view {arguments.view!r}; there are {[v.name for v in stored.dataset.test]}")
    frame, _ = timed_render(stored.renderer, stored.scene, view)
    panels = [Panel("photograph", view.photo), Panel("render", quantized(frame.rgb))]
    for layer in (layer for layer in PARTS if layer in frame.layers):
        image = normal_colors(frame.layers[layer]) if layer == "normal" else frame.layers[layer]
        panels.append(Panel(PARTS[layer], quantized(image)))
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    write_image(arguments.output, composed([panels], "", "")[TITLE_HEIGHT:])


if __name__ == "__main__":
    main()
