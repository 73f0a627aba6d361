"""Records of discs (2DGS) that the kernel operations hand to each other.

`C` cameras, `N` discs. Dense layout: what a camera does not see has `radii == 0` and `opacities == 0`.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from glassplat.kernels.splats import Splats

FLAT, SOLID = 2, 3
"""Scales of a disc and of an ellipsoid."""


class ProjectedDiscs(NamedTuple):
    """Discs on screen.

    means2d [C, N, 2] pixels. maps [C, N, 6]: where a pixel's ray meets the disc (`maths/disc.py`). depths [C, N] of the
    centres, camera z; opacities [C, N] in (0, 1); colors [C, N, 3]; normals [C, N, 3] unit, world axes, towards the
    camera. outline_centers [C, N, 2], outline_conics [C, N, 3]: an ellipse around what a disc covers with at least
    1/255, for `bin_tiles`; conics of zeros for one that crosses the near plane. radii [C, N, 2] half extents of that
    ellipse in pixels, 0 where culled.
    """

    means2d: Tensor
    maps: Tensor
    depths: Tensor
    opacities: Tensor
    colors: Tensor
    normals: Tensor
    outline_centers: Tensor
    outline_conics: Tensor
    radii: Tensor

    @property
    def outlines(self) -> Splats:
        """What `bin_tiles` takes for these discs."""
        return Splats(self.outline_centers, self.outline_conics, self.opacities, self.depths, self.radii)


class Discs(NamedTuple):
    """What blending needs of each disc; fields as in `ProjectedDiscs`, [C, N, ...]."""

    means2d: Tensor
    maps: Tensor
    opacities: Tensor
    depths: Tensor
    outlines: Splats
