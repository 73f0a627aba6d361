"""How much an image behind a pane changes with its two layers."""

from glassplat.kernels.layer_slopes.operation import layer_slopes, slopes_at

__all__ = ["layer_slopes", "slopes_at"]
