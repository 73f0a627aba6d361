"""Which way ellipsoids face, for methods that do not shade by it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from glassplat.kernels.composite import composite
from glassplat.kernels.environment import surface_channels
from glassplat.kernels.records import NORMAL_AT, STRENGTH_AT
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.frame import Frame, Renderer
from glassplat.render.rasterize import NEAR_PER_EXTENT, joined_splats, project_gaussians
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class WithNormals:
    """The frames of a renderer, with a layer `normal` [H, W, 3] where they have none.

        n(u) = sum_i n_i alpha_i T_i

    n_i is the shortest axis of ellipsoid i, turned to the camera (3DGS-DR, Section 3.1). Of what panes stand before it
    is the things behind them, as the layer `depth` is. Costs a pass of its own.

    Attributes:
        renderer: whose frames these are; scenes of discs get their normals from it.
    """

    renderer: Renderer

    def __call__(self, scene: Scene, camera: Camera, *, probed: bool = False) -> Frame:
        """Renders `scene` from `camera`, where the scene's tensors are."""
        frame = self.renderer(scene, camera, probed=probed)
        if "normal" in frame.layers:
            return frame
        normals = ellipsoid_normals(scene, camera.to(scene.primary.means.device))
        return replace(frame, layers={**frame.layers, "normal": normals})

    def check(self, scene: Scene) -> None:
        """As the renderer does."""
        self.renderer.check(scene)


def ellipsoid_normals(scene: Scene, camera: Camera) -> Tensor:
    """[H, W, 3] blended normals of the primary Gaussians, world axes, towards the camera, at most of unit length."""
    gaussians = scene.primary
    projected = project_gaussians(gaussians, camera, near=NEAR_PER_EXTENT * scene.extent)
    channels = surface_channels(
        projected.colors[0],
        projected.radii[0],
        gaussians.quats,
        gaussians.log_scales,
        gaussians.means,
        gaussians.means.new_zeros(len(gaussians)),
        camera.center,
    )
    splats = joined_splats(projected)
    bins = bin_tiles(splats, camera.width, camera.height)
    return composite(splats, channels[None, :, NORMAL_AT:STRENGTH_AT].contiguous(), bins).image[0]
