"""Mirror images in uneven glass: Gaussians seen a little beside where an even pane would show them."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.records import Projected
from glassplat.render.seen_panes import SeenPanes, panes_in_camera
from glassplat.scene.camera import Camera
from glassplat.scene.uneven import slopes_at


def in_uneven_glass(mirrored: Projected, seen: SeenPanes, camera: Camera) -> Projected:
    """Moves mirror images to where uneven panes show them; the same where all glass is even.

    A normal n that is turned to n - delta turns the mirrored ray of the direction d, as the mirrored camera sees it,
    to d - 2 (d . delta) n + 2 (d . n) delta. What lies the distance s beyond the glass is met by the ray that was
    aimed s times that turn beside it. First order in the slopes, which are hundredths of a radian at most. What a
    Gaussian looks like is left as it is, so that glass that magnifies leaves gaps of that share between them.

    The way it moves is differentiable in the panes' heights only.

    Args:
        mirrored: [K, N] what each pane mirrors.
        seen: the panes.
        camera: of the view.
    """
    heights = seen.planes.level_heights
    if heights is None:
        return mirrored
    where = (mirrored.radii[..., 0] > 0).nonzero(as_tuple=True)
    means2d = mirrored.means2d.detach()
    virtual = _in_camera(means2d[where], mirrored.depths.detach()[where], camera)
    panes, pane = panes_in_camera(seen.planes, camera), where[0]
    center, normal, axes, half_sizes = (tensor[pane] for tensor in panes)
    towards = (virtual * normal).sum(-1, keepdim=True)
    to_glass = (center * normal).sum(-1, keepdim=True) / towards
    places = ((to_glass * virtual - center)[:, None] * axes).sum(-1) / half_sizes
    slopes = slopes_at(heights, pane, places) / half_sizes
    delta = (slopes[..., None] * axes).sum(1)
    turned = 2 * towards * delta - 2 * (virtual * delta).sum(-1, keepdim=True) * normal
    moved = _on_screen(virtual - (1 - to_glass) * turned, camera) - _on_screen(virtual, camera)
    return mirrored._replace(means2d=mirrored.means2d + torch.zeros_like(means2d).index_put(where, moved))


def _in_camera(means2d: Tensor, depths: Tensor, camera: Camera) -> Tensor:
    """[N, 3] camera frame, of pixels [N, 2] and depths [N]."""
    focal, middle = camera.intrinsics.to(means2d).split(2)
    return torch.cat([(means2d - middle) / focal, torch.ones_like(depths)[:, None]], dim=-1) * depths[:, None]


def _on_screen(places: Tensor, camera: Camera) -> Tensor:
    """[N, 2] pixels, of places [N, 3] in the camera frame."""
    focal, middle = camera.intrinsics.to(places).split(2)
    return places[:, :2] / places[:, 2:] * focal + middle
