"""Sorts splats into the tiles of the image that they touch, front to back."""

from glassplat.kernels.bin_tiles.operation import TILE, bin_tiles, tile_grid

__all__ = ["TILE", "bin_tiles", "tile_grid"]
