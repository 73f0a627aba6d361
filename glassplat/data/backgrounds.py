"""Colours behind everything, which are seen through transparent photographs."""

from __future__ import annotations

Rgb = tuple[float, float, float]
"""sRGB in [0, 1]."""
WHITE: Rgb = (1.0, 1.0, 1.0)
BLACK: Rgb = (0.0, 0.0, 0.0)
"""Behind captures of places, which fill their photographs."""
