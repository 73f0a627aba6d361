"""Sorts splats into the tiles of the image that they touch, front to back."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.records import TILE, Splats, TileBins, check_device, check_tensors


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Number of rows and columns of tiles that cover an image of the given size in pixels."""
    return -(-height // TILE), -(-width // TILE)


@torch.no_grad()
def bin_tiles(splats: Splats, width: int, height: int, active_tiles: Tensor | None = None) -> TileBins:
    """Lists, for every tile of every camera, the splats that cover any of its pixels, nearest first.

    A splat is listed in a tile if its ellipse {coverage >= 1/255} crosses the tile's rows of pixel centres, which adds
    few tiles without a covered pixel. Equal depths keep the order of the splats. Not differentiable.

    Args:
        splats: [C, G, ...]; those with `radii == 0` are skipped. Depths of all others must be positive.
        width: of the image, pixels.
        height: of the image, pixels.
        active_tiles: [C, rows, columns] bool, tiles to rasterise; all if None.
    """
    _check(splats, width, height, active_tiles)
    plain = Splats(*(tensor.detach().contiguous() for tensor in splats))
    mask = None if active_tiles is None else active_tiles.contiguous()
    bins: TileBins = kernels_for("tiles", splats.depths.device).bin_tiles(plain, width, height, mask)
    return bins


def _check(splats: Splats, width: int, height: int, active_tiles: Tensor | None) -> None:
    if width < 1 or height < 1:
        raise ValueError(f"the image is {width} x {height} pixels; expected at least 1 x 1")
    leading = tuple(splats.depths.shape)
    if len(leading) != 2:
        raise ValueError(f"depths has shape {leading}; expected (cameras, splats)")
    trailing = {"depths": (), "means2d": (2,), "conics": (3,), "opacities": (), "radii": (2,)}
    check_tensors({name: (getattr(splats, name), leading + rest) for name, rest in trailing.items()})
    if active_tiles is None:
        return
    check_device("active_tiles", active_tiles, "depths", splats.depths)
    expected = (leading[0], *tile_grid(width, height))
    if tuple(active_tiles.shape) != expected or active_tiles.dtype != torch.bool:
        raise ValueError(
            f"active_tiles is {active_tiles.dtype} of shape {tuple(active_tiles.shape)}; expected bool of shape "
            f"{expected}, (cameras, tile rows, tile columns)"
        )
