"""Sorts splats into the tiles of the image that they touch, front to back."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from glassplat.kernels.cpu.bin_tiles import TILE, depth_order, tile_pairs, tile_spans
from glassplat.kernels.splats import Splats, TileBins
from glassplat.kernels.tensor_checks import REAL_OF, check_tensors

KEY_OF = {torch.float32: np.uint32, torch.float64: np.uint64}
MOST_PAIRS = 2**31 - 1

__all__ = ["TILE", "bin_tiles", "tile_grid"]


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Rows and columns of tiles that cover an image of that size in pixels."""
    return -(-height // TILE), -(-width // TILE)


@torch.no_grad()
def bin_tiles(splats: Splats, width: int, height: int, active_tiles: Tensor | None = None) -> TileBins:
    """Lists, for every tile of every camera, the splats that cover any of its pixels, nearest first.

    A splat is listed where its ellipse {coverage >= 1/255} crosses the rows of pixel centres of a tile: every tile with
    such a pixel, and hardly any other. Equal depths keep the order of the splats. Not differentiable.

    Args:
        splats: [C, G, ...]; those with `radii == 0` are left out. Depths must be positive where they are not.
        width: of the image, pixels.
        height: of the image, pixels.
        active_tiles: [C, rows, columns] bool, tiles to fill and traverse; all if None.

    Raises:
        ValueError: a shape or the image size is wrong, or there are more pairs than an int32 can count.
        TypeError: tensors of different or unsupported types, or not on the CPU.
    """
    _check(splats, width, height, active_tiles)
    num_cameras, per_camera = splats.depths.shape
    (rows, columns), count = tile_grid(width, height), num_cameras * per_camera
    real = REAL_OF[splats.depths.dtype]
    flat = [t.detach().contiguous().numpy() for t in splats]
    means2d, conics, opacities, depths, radii = (a.reshape(count, *a.shape[2:]) for a in flat)
    mask = np.zeros((0, 0, 0), np.bool_) if active_tiles is None else active_tiles.contiguous().numpy()
    spans, span_offsets, first_rows, splat_offsets = tile_spans(real)(
        means2d, conics, opacities, radii, mask, num_cameras, width, height
    )
    if splat_offsets[-1] > MOST_PAIRS:
        raise ValueError(
            f"{splat_offsets[-1]} (tile, splat) pairs are more than the {MOST_PAIRS} that can be indexed; render fewer "
            f"cameras at once or a smaller image"
        )
    keys = depths.view(KEY_OF[splats.depths.dtype])
    order, starts = depth_order(KEY_OF[splats.depths.dtype])(keys, splat_offsets, num_cameras)
    pair_splats, tile_offsets, pair_slots = tile_pairs()(
        order, starts, spans, span_offsets, first_rows, splat_offsets, mask, rows, columns
    )
    tiles = num_cameras * rows * columns
    active = torch.arange(tiles) if active_tiles is None else active_tiles.flatten().nonzero()[:, 0]
    return TileBins(
        pair_splats=torch.from_numpy(pair_splats),
        tile_offsets=torch.from_numpy(tile_offsets),
        pair_slots=torch.from_numpy(pair_slots),
        splat_offsets=torch.from_numpy(splat_offsets),
        active=active.to(torch.int32),
        width=width,
        height=height,
        num_cameras=num_cameras,
    )


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
    expected = (leading[0], *tile_grid(width, height))
    if tuple(active_tiles.shape) != expected or active_tiles.dtype != torch.bool:
        raise ValueError(
            f"active_tiles is {active_tiles.dtype} of shape {tuple(active_tiles.shape)}; expected bool of shape "
            f"{expected}, (cameras, tile rows, tile columns)"
        )
