"""Where an evaluation takes the panes of a capture from."""

from __future__ import annotations

from glassplat.commands.measuring.evaluate import PaneSource
from glassplat.data.dataset import Dataset
from glassplat.data.errors import InputError
from glassplat.evaluate.pane_regions import MarkedRegions, PaneRegions, RenderedRegions, TrueRegions
from glassplat.init.plane_options import PlaneFit, PlaneFitError
from glassplat.train.plane_entry import fitted_planes


def pane_regions(dataset: Dataset, source: PaneSource) -> PaneRegions:
    """The pixels that show panes, from the source of this name.

    Raises:
        InputError: the capture has no such source.
    """
    if source == "auto":
        return _best_regions(dataset)
    if source == "masks":
        return _marked_regions(dataset)
    if source == "truth" and dataset.truth is None:
        raise InputError(f"{dataset.root} has no folder gt/ that says where its panes are; use --panes masks")
    return TrueRegions() if source == "truth" else RenderedRegions()


def _best_regions(dataset: Dataset) -> PaneRegions:
    """Those that say most surely where the panes are."""
    if dataset.truth is not None:
        return TrueRegions()
    try:
        return _marked_regions(dataset)
    except InputError:
        return RenderedRegions()


def _marked_regions(dataset: Dataset) -> MarkedRegions:
    """Those of the masks, with planes fitted as any method would begin, so that all are measured alike."""
    if not dataset.pane_labels and dataset.planes is None:
        raise InputError(f"{dataset.root} has no masks that name a pane; use --panes rendered, or add masks")
    try:
        # The rectangle's margin is for training, which must not cut into a pane.
        return MarkedRegions(fitted_planes(dataset, None, PlaneFit(margin=1.0)))
    except PlaneFitError as error:
        raise InputError(f"the masks of {dataset.root} lead to no plane: {error}. Use --panes rendered") from error
