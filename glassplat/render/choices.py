"""What renderers leave to choose, by name."""

from __future__ import annotations

from typing import Literal

Blend = Literal["srgb", "linear"]
"""The space in which transmission and reflection are blended: as photographed, or in radiance."""
Shading = Literal["deferred", "forward"]
"""Whether each pixel is shaded, or each Gaussian."""
