"""Which panes a view shows, one behind another."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from glassplat.kernels.panes import pane_hits
from glassplat.kernels.records import PaneHits, Panes
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.transfer import constant


@dataclass(frozen=True)
class SeenPanes:
    """The panes that a view shows; only the nearest on each ray, or several that are seen through one another.

    Attributes:
        planes: the K panes that some tile shows.
        rows: [K] their positions among the scene's planes.
        order: L tensors [H, W] int32, L >= 1: the panes that each pixel's ray meets, nearest first, as positions in
            `planes`; -1 where there is none left.
        tiles: [K, rows, columns] bool, tiles in which a pixel shows the pane, in front or through others.
        windows: [K, 4] left, top, right and bottom edge, in pixels, of the pixels that show it.
    """

    planes: Planes
    rows: Tensor
    order: tuple[Tensor, ...]
    tiles: Tensor
    windows: Tensor


def panes_in_camera(planes: Planes, camera: Camera) -> Panes:
    """The rectangles in the camera frame; no gradient."""
    with torch.no_grad():
        rotation, translation = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
        centers, normals, axes, half_sizes = (
            tensor.to(rotation)
            for tensor in (planes.centers, planes.normals, torch.stack(planes.axes(), 1), planes.half_sizes)
        )
        return Panes(centers @ rotation.T + translation, normals @ rotation.T, axes @ rotation.T, half_sizes)


def nearest_hits(panes: Panes, camera: Camera, mask: Tensor | None = None, beyond: PaneHits | None = None) -> PaneHits:
    """The nearest of `panes_in_camera` on the ray of each pixel, or the next one; see `pane_hits`."""
    return pane_hits(panes, camera.intrinsics, camera.width, camera.height, mask, beyond=beyond)


def seen_panes(
    planes: Planes, camera: Camera, first: PaneHits, mask: Tensor | None = None, *, most: int | None = None
) -> SeenPanes | None:
    """The panes on the ray of each pixel, None where no tile shows any; the planes keep their gradient.

    Args:
        planes: the scene's.
        camera: of the view.
        first: `nearest_hits` of these.
        mask: [H, W] as given to `nearest_hits`.
        most: how many of them on one ray, the nearest ones; all if None.
    """
    hits, seen = [first], _shown(first)
    if not any(seen):
        return None
    while len(hits) < (len(planes) if most is None else most):
        further = nearest_hits(panes_in_camera(planes, camera), camera, mask, beyond=hits[-1])
        shown = _shown(further)
        if not any(shown):
            break
        hits.append(further)
        seen = [a or b for a, b in zip(seen, shown, strict=True)]
    tiles = torch.stack([h.tiles for h in hits]).any(dim=0)
    windows = first.windows if len(hits) == 1 else _joined_windows(hits)
    positions = tuple(k for k, is_seen in enumerate(seen) if is_seen)
    rows = constant(positions, torch.int64, tiles.device)
    if len(positions) == len(planes):
        return SeenPanes(planes, rows, tuple(h.pane for h in hits), tiles, windows)
    # The last entry is for index -1, pixels without a pane.
    found = (*(positions.index(k) if is_seen else -1 for k, is_seen in enumerate(seen)), -1)
    position = constant(found, torch.int32, tiles.device)
    order = tuple(position[h.pane.long()] for h in hits)
    return SeenPanes(planes.select(positions), rows, order, tiles[rows], windows[rows])


def _shown(hits: PaneHits) -> list[bool]:
    """Which panes some tile shows. The one thing that the program asks of a GPU here, and waits for."""
    found: list[bool] = hits.tiles.flatten(1).any(dim=1).tolist()
    return found


def _joined_windows(hits: list[PaneHits]) -> Tensor:
    """[K, 4] the smallest windows around those of all hits; an empty window is all 0."""
    windows = torch.stack([h.windows for h in hits])
    empty = (windows[..., 2] == 0)[..., None]
    first = torch.where(empty, torch.inf, windows[..., :2]).amin(dim=0)
    joined = torch.cat([first, windows[..., 2:].amax(dim=0)], dim=1)
    return torch.where(empty.all(dim=0), 0, joined)


@torch.no_grad()
def glass_owners(glass: Gaussians, planes: Planes) -> Tensor:
    """[M] the plane whose rectangle is nearest to each glass Gaussian, position in `planes`."""
    offsets = glass.means[:, None] - planes.centers
    along = torch.stack([(offsets * axis).sum(-1) for axis in planes.axes()], dim=-1)
    outside = (along.abs() - planes.half_sizes).clamp(min=0)
    across = (offsets * planes.normals).sum(-1, keepdim=True)
    return torch.cat([outside, across], dim=-1).square().sum(-1).argmin(dim=1)
