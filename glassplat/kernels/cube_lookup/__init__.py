"""Looks up a cube map in directions."""

from glassplat.kernels.cube_lookup.operation import check_cube, cube_lookup

__all__ = ["check_cube", "cube_lookup"]
