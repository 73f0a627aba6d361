"""The README's picture: one test view of a finished `planar` run, taken apart.

python tools/make_readme_picture.py RUN --view 0016.jpg --output docs/images/showcase.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

from glassplat.commands.stored_run import open_run
from glassplat.evaluate.evaluate import timed_render
from glassplat.evaluate.metrics import quantized
from glassplat.evaluate.sheet import TITLE_HEIGHT, Panel, composed
from glassplat.files.images import write_image


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
    panels = [
        Panel("photograph", view.photo),
        Panel("render", quantized(frame.rgb)),
        Panel("behind the glass", quantized(frame.layers["transmission"])),
        Panel("reflected by it", quantized(frame.layers["reflection"])),
    ]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    write_image(arguments.output, composed([panels], "", "")[TITLE_HEIGHT:])


if __name__ == "__main__":
    main()
