"""Which pixels of a test view show a pane: the same ones for every method that is scored over them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from glassplat.data.view import View
from glassplat.evaluate.truth import TrueView
from glassplat.render.frame import Frame
from glassplat.render.seen_panes import nearest_hits, panes_in_camera
from glassplat.scene.plane import Planes

NO_TRUTH = "the data set has no ground truth"
NO_VIEW_TRUTH = "the ground truth lacks this view"


class PaneRegions(Protocol):
    """One source for the whole data set, so that means do not mix two."""

    @property
    def source(self) -> str:
        """What the region is, for whoever reads the metrics."""
        ...

    def of(self, view: View, frame: Frame, truth: TrueView | None) -> Tensor | str:
        """The pixels of a view that show a pane, [H, W] bool, or why they are not known."""
        ...


@dataclass(frozen=True)
class TrueRegions:
    """What the ground truth says."""

    source: str = "ground-truth pane labels"

    def of(self, view: View, frame: Frame, truth: TrueView | None) -> Tensor | str:
        """As in `PaneRegions`."""
        return NO_VIEW_TRUTH if truth is None else truth.labels > 0


@dataclass(frozen=True)
class MarkedRegions:
    """The view's mask, or without one what the planes fitted to the masks cover; what stands before them included.

    Attributes:
        planes: fitted to the masks and to measured points, whatever was trained.
    """

    planes: Planes
    source: str = "masks, and in views without one the planes fitted to them"

    def of(self, view: View, frame: Frame, truth: TrueView | None) -> Tensor | str:
        """As in `PaneRegions`."""
        if view.pane_labels is not None:
            return view.pane_labels > 0
        return nearest_hits(panes_in_camera(self.planes, view.camera), view.camera).pane >= 0


@dataclass(frozen=True)
class RenderedRegions:
    """Where the method itself draws a pane, so that methods may be scored over different pixels."""

    source: str = "rendered mask > 0.5"

    def of(self, view: View, frame: Frame, truth: TrueView | None) -> Tensor | str:
        """As in `PaneRegions`."""
        if "mask" in frame.layers:
            return frame.layers["mask"] > 0.5
        return f"{NO_TRUTH}, and the method renders no mask"
