"""Where panes are, and where nothing but one of them is."""

from glassplat.kernels.pane_layers.operation import pane_layers

__all__ = ["pane_layers"]
