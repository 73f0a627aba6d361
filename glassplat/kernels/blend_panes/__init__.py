"""Blends what is behind the panes with what they reflect."""

from glassplat.kernels.blend_panes.operation import blend_panes

__all__ = ["blend_panes"]
