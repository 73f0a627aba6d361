"""What panes mirror, on screen: Gaussians as cameras see them that are mirrored about each pane."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.project import GradientSum
from glassplat.kernels.records import Projected
from glassplat.render.rasterize import project_gaussians
from glassplat.render.seen_panes import SeenPanes
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.photographer import world_from_photographer
from glassplat.scene.plane import Planes
from glassplat.scene.pose import mirror_matrices
from glassplat.scene.scene import Scene


def project_mirrored(
    gaussians: Gaussians, camera: Camera, seen: SeenPanes, *, near: float, total: GradientSum | None = None
) -> Projected:
    """Projects the Gaussians of the camera's side into the camera mirrored about each plane (Eqs. 8-12).

    Args:
        gaussians: the set to project.
        camera: whose mirror images are wanted.
        seen: the planes that it sees, and where; what lies outside of a plane's window is culled.
        near: depth below which a Gaussian is culled, world units.
        total: as for `project_gaussians`.
    """
    return project_gaussians(
        gaussians,
        camera,
        near=near,
        poses=camera.cam_from_world @ mirror_matrices(seen.planes.centers, seen.planes.normals),
        clip_planes=half_spaces_of(seen.planes, camera),
        windows=seen.windows,
        total=total,
    )


def project_photographer(scene: Scene, camera: Camera, seen: SeenPanes, *, near: float) -> Projected:
    """Projects the photographer's mirror images: what `project_mirrored` does, of Gaussians that the camera carries.

    Mirrored about plane k, the camera sees them at `cam_from_world @ M_k @ world_from_photographer`; all else, also
    the depths by which they are sorted into the room, follows from that pose.

    Args:
        scene: with a photographer.
        camera: that the photographer holds.
        seen: the planes that it sees, and where.
        near: depth below which a Gaussian is culled, world units.
    """
    frame = world_from_photographer(camera, scene.up)
    half_spaces = half_spaces_of(seen.planes, camera)
    return project_gaussians(
        scene.photographer,
        camera,
        near=near,
        poses=camera.cam_from_world @ mirror_matrices(seen.planes.centers, seen.planes.normals) @ frame,
        # A plane n . x + d = 0 is (n, d) as a row vector, so that frames change it from the right.
        clip_planes=half_spaces @ frame.detach(),
        windows=seen.windows,
    )


def half_spaces_of(planes: Planes, camera: Camera) -> Tensor:
    """Clip planes [K, 4] that keep each plane's side on which the camera stands; no gradient."""
    with torch.no_grad():
        normals = planes.normals
        side = torch.sign(((camera.center - planes.centers) * normals).sum(-1, keepdim=True))
        facing = normals * side
        return torch.cat([facing, -(facing * planes.centers).sum(-1, keepdim=True)], dim=1)
