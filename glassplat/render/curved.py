"""Curved mirrors where there are panes: what the camera and its mirror images see of them, shaded as `traced` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.trace import Rays
from glassplat.render.frame import Frame
from glassplat.render.mirror_images import half_spaces_of
from glassplat.render.seen_panes import SeenPanes, nearest_hits, panes_in_camera, seen_panes
from glassplat.render.surface import Surface, seen_surface
from glassplat.render.traced import Traced, mirrored_contributions, surface_contributions
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.pose import mirror_matrices
from glassplat.scene.scene import Scene


class Shades(NamedTuple):
    """Surfaces with what they mirror.

    surfaces of C cameras; images and reflections [H, W, 3] of each; the rays that went off.
    """

    surfaces: tuple[Surface, ...]
    images: tuple[Tensor, ...]
    reflections: tuple[Tensor, ...]
    rays: Rays


def shades_of(curved: Traced, scene: Scene, cameras: Sequence[Camera], surfaces: Sequence[Surface]) -> Shades:
    """Shades what cameras see, one surface each."""
    shaded, rays = curved.shaded(scene, cameras, surfaces)
    images, reflections = zip(*shaded, strict=True)
    return Shades(tuple(surfaces), images, reflections, rays)


def mirrored_cameras(camera: Camera, planes: Planes) -> list[Camera]:
    """The camera mirrored about each plane, left-handed; the planes keep their gradient."""
    poses = camera.cam_from_world @ mirror_matrices(planes.centers, planes.normals)
    return [replace(camera, cam_from_world=pose) for pose in poses]


def within_panes(surfaces: Sequence[Surface], seen: SeenPanes) -> list[Surface]:
    """What K mirrored cameras see, empty where no ray of the view itself meets their pane: nothing mirrors there."""
    inside = [torch.stack([pane == row for pane in seen.order]).any(dim=0) for row in range(len(surfaces))]
    return [
        replace(surface, depth=torch.where(hit, surface.depth, 0))
        for surface, hit in zip(surfaces, inside, strict=True)
    ]


def curved_layers(shades: Shades) -> dict[str, Tensor]:
    """The layers of a view, under names that those of panes have not."""
    layers = shades.surfaces[0].layers()
    return {
        "base": layers["base"],
        "normal": layers["normal"],
        "curved_strength": layers["strength"],
        "curved_reflection": shades.reflections[0],
    }


def mirrors_anything(scene: Scene) -> bool:
    """Whether the scene's things may reflect, and there is something for them to mirror."""
    surrounded = len(scene.surroundings) > 0 or not scene.environment.is_empty
    return surrounded and "logit_strength" in scene.primary.channels


def with_matte_layers(frame: Frame) -> Frame:
    """A frame with the layers that it would have if nothing but panes were found to reflect."""
    image, nothing = frame.layers["without_panes"], torch.zeros_like(frame.layers["alpha"])
    black = torch.zeros_like(image)
    matte = {"base": image, "normal": black, "curved_strength": nothing, "curved_reflection": black}
    return replace(frame, layers={**frame.layers, **matte, "surroundings": black})


def curved_contributions(scene: Scene, camera: Camera) -> Tensor:
    """[N] how many pixels' worth each Gaussian of the surroundings adds to a view, directly or in a pane, at the most.

    As `mirrored_contributions`, of which there is one for each pane as well.
    """
    camera = camera.to(scene.primary.means.device)
    most = mirrored_contributions(scene, camera)
    seen = seen_panes(scene.planes, camera, nearest_hits(panes_in_camera(scene.planes, camera), camera))
    if seen is None:
        return most
    cameras = mirrored_cameras(camera, seen.planes)
    with torch.no_grad():
        surfaces = [
            seen_surface(replace(scene, primary=before(scene.primary, half)), mirrored, background=(0.0, 0.0, 0.0))
            for mirrored, half in zip(cameras, half_spaces_of(seen.planes, camera), strict=True)
        ]
    for mirrored, surface in zip(cameras, within_panes(surfaces, seen), strict=True):
        most = torch.maximum(most, surface_contributions(scene, mirrored, surface))
    return most


def before(gaussians: Gaussians, half_space: Tensor) -> Gaussians:
    """Those of a set whose centres lie in a half space [4]."""
    return gaussians.select(gaussians.means @ half_space[:3] + half_space[3] > 0)
