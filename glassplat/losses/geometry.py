"""Where the primary Gaussians lie along a pixel's ray, and which way the surface faces."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.data.dataset import View
from glassplat.render.depth_normals import cell_means, cell_side, depth_normals
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene


def depth_deviation_loss(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Depth variance loss L_d over the hit mask (TR-Gaussians, Eq. 14).

    The image mean of H(u) sum_i |z_i - D_t(u)| w_i, the `deviation` layer, divided by the scene extent so that its
    weight does not depend on the capture's units.
    """
    return frame.layers["deviation"].mean() / scene.extent


def normal_consistency(frame: Frame, view: View, scene: Scene) -> Tensor:
    """How far the blended normals are from those of the surface that the depths describe (after 2DGS, Eq. 14).

    The mean of 1 - n . n_d over the cells of a coarse grid: n is the mean layer `normal`, made unit, n_d the normal of
    the mean depths. Both have a gradient: where depths are right they turn the normals, and where reflections have
    found the normals, these smooth the surface.
    Cells on an edge of the depth map, or not covered, count as 0.
    """
    from_depth, trusted = depth_normals(frame.layers["depth"], frame.layers["alpha"].detach(), view.camera)
    blended = torch.nn.functional.normalize(cell_means(frame.layers["normal"], cell_side(view.camera)), dim=-1)
    return (trusted.detach() * (1 - (blended * from_depth).sum(-1))).mean()
