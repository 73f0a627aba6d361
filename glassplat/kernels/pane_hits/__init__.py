"""Which pane each pixel shows."""

from glassplat.kernels.pane_hits.operation import pane_hits

__all__ = ["pane_hits"]
