"""Layers that renderers draw only when they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from glassplat.render.deferred import Deferred
from glassplat.render.frame import Renderer
from glassplat.render.planar import Planar, with_photographer
from glassplat.render.shortest_axes import WithNormals
from glassplat.render.splat import Splat
from glassplat.render.traced import Traced

PHOTOGRAPHED: Final = "photographed"
"""The image with whom the panes of a photograph show, of runs that looked for somebody."""


def renderer_with(renderer: Renderer, layers: Sequence[str]) -> Renderer:
    """The renderer, also of those of the layers that it renders only when asked."""
    if isinstance(renderer, Deferred):
        return replace(renderer, environment=renderer.environment or "environment" in layers)
    if isinstance(renderer, Traced):
        return replace(renderer, surroundings=renderer.surroundings or "surroundings" in layers)
    renderer = with_photographer(renderer, "beside") if PHOTOGRAPHED in layers else renderer
    return WithNormals(renderer) if "normal" in layers and isinstance(renderer, Planar | Splat) else renderer
