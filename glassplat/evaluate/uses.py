"""A picture of what the layers are good for: photographs without reflections, and panes as mirrors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from glassplat.evaluate.evaluate import EvaluatedView
from glassplat.evaluate.metrics import quantized
from glassplat.evaluate.sheet import Panel, composed
from glassplat.render.choices import Blend
from glassplat.render.dereflect import as_mirror_image, dereflected_photo

MOST_VIEWS = 2
SMALLEST_SHARE = 0.05
"""Part of the image that must be pane for a view to be worth showing."""


class Uses:
    """Keeps the views that show most of a pane, out of all that pass by, and draws them."""

    def __init__(self, blend: Blend) -> None:
        """Begins with no view; `blend` is the space in which the run blends the reflection."""
        self._blend = blend
        self._rows: list[tuple[float, list[Panel]]] = []

    def add(self, evaluated: EvaluatedView) -> None:
        """Looks at a view, and keeps its panels if it shows more of a pane than those kept."""
        frame, photo = evaluated.frame, evaluated.view.photo
        share = float((frame.layers["strength"] > 0).float().mean())
        if share < SMALLEST_SHARE:
            return
        plain = dereflected_photo(frame, photo, self._blend, exposures=evaluated.exposures, name=evaluated.view.name)
        row = [
            Panel(f"photograph {evaluated.view.name}", photo),
            Panel("without reflections (glassplat dereflect)", plain),
            Panel("pane as a mirror (glassplat render --as-mirror)", quantized(as_mirror_image(frame, self._blend))),
        ]
        self._rows = sorted([*self._rows, (share, row)], key=lambda kept: -kept[0])[:MOST_VIEWS]

    def picture(self) -> NDArray[np.uint8] | None:
        """The views kept [H, W, 3], one per row; None where no view shows a pane."""
        return composed([row for _, row in self._rows], "What the layers are good for", "") if self._rows else None
