"""Blends discs over each pixel."""

from glassplat.kernels.composite_discs.operation import BlendedDiscs, composite_discs

__all__ = ["BlendedDiscs", "composite_discs"]
