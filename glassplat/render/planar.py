"""`planar`: Gaussians behind and in front of flat panes (TR-Gaussians)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.bin_tiles import TILE, bin_tiles
from glassplat.kernels.composite import composite
from glassplat.kernels.depth_deviation import depth_deviation
from glassplat.kernels.splats import Splats, TileBins
from glassplat.render.color_space import linear_from_srgb, srgb_from_linear
from glassplat.render.frame import Frame, ScreenPass
from glassplat.render.rasterize import NEAR_PER_EXTENT, joined_splats, mean_depth, over_background, project_gaussians
from glassplat.render.reflectance import constant_strength, nearest_hits, schlick_strength
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.pose import mirror_matrices
from glassplat.scene.scene import Scene

Blend = Literal["srgb", "linear"]


class FirstPass(NamedTuple):
    """Everything seen straight through the camera."""

    transmission: Tensor
    alpha: Tensor
    depth: Tensor
    mask: Tensor
    splats: Splats
    bins: TileBins
    screen: tuple[ScreenPass, ...]


class SecondPass(NamedTuple):
    """What the panes mirror, merged over the panes: image [H, W, 3] and intensity [H, W]."""

    raw_reflection: Tensor
    intensity: Tensor
    screen: ScreenPass


@dataclass(frozen=True)
class Planar:
    """Renders transmission, reflection and their blend (TR-Gaussians, Section III-A).

        C = (1 - R) C_t + R C_r                      (Eq. 1)
        R = M sum_k H_k R_k,  R_k by Schlick         (Eqs. 5, 6, 19)
        C_r = C_raw A                                (Eq. 13)

    The first pass blends the primary Gaussians into C_t and, with the glass Gaussians among them,
    the mask M (Eq. 7). The second pass renders the primary Gaussians of the camera's side through
    cameras mirrored about each plane, which is the same as mirroring the Gaussians (Eqs. 8-12), and
    only in tiles where that pane is seen.

    Layers: `transmission`, `reflection` [H, W, 3]; `strength`, `mask`, `depth`, `alpha`, `hit`
    [H, W]; `deviation` [H, W] (Eq. 14) if asked for.

    Attributes:
        background: colour behind everything, sRGB.
        fresnel: strength by Schlick; False uses R0 for every angle.
        intensity: use the learned intensity a(u); False sets C_r = C_raw.
        reflection_gradient: what the reflection image's gradient reaches: everything, or the planes alone.
        deviation: also compute the depth deviation, for training.
        deviation_depth_gradient: let the deviation's gradient pass through the mean depth D_t.
        blend: space in which Eqs. 1 and 13 hold: linear radiance, where light adds up, or sRGB as in the paper.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fresnel: bool = True
    intensity: bool = True
    reflection_gradient: Literal["all", "planes"] = "all"
    deviation: bool = False
    deviation_depth_gradient: bool = False
    blend: Blend = "linear"

    def __call__(self, scene: Scene, camera: Camera) -> Frame:
        """Renders `scene` from `camera`."""
        first = self._first_pass(scene, camera)
        layers = {"transmission": first.transmission, "depth": first.depth, "alpha": first.alpha, "mask": first.mask}
        hits = nearest_hits(scene.planes, camera)
        seen = [k for k in range(len(scene.planes)) if bool(hits[k].any())]
        if not seen:
            zero = torch.zeros_like(first.alpha)
            layers |= {"reflection": torch.zeros_like(first.transmission), "strength": zero, "hit": zero}
            layers |= {"deviation": zero} if self.deviation else {}
            return Frame(first.transmission, layers, first.screen)
        planes, hits = select_planes(scene.planes, seen), hits[seen]
        hit = hits.any(dim=0)
        if self.deviation:
            layers["deviation"] = self._deviation(first, hit, len(scene.primary))
        second = self._second_pass(scene, camera, planes, hits & (first.mask.detach() > 0))
        raw_strength = schlick_strength(planes, camera) if self.fresnel else constant_strength(planes, camera)
        strength = (raw_strength * hits).sum(dim=0) * first.mask
        rgb, reflection = self._blend(first, second, strength, hit)
        layers |= {"reflection": reflection, "strength": strength, "hit": hit.to(strength.dtype)}
        mirrored = replace(second.screen, weight=float(strength.detach()[hit].mean()))
        return Frame(rgb, layers, (*first.screen, mirrored))

    def _blend(self, first: FirstPass, second: SecondPass, strength: Tensor, hit: Tensor) -> tuple[Tensor, Tensor]:
        """Image and reflection [H, W, 3]; the curves of colour spaces cost much, so only hit pixels are computed."""
        behind, reflected = first.transmission[hit], second.raw_reflection[hit]
        if self.intensity:
            reflected = brightened(reflected, second.intensity[hit][:, None], self.blend)
        mixed = blended(behind, reflected, strength[hit][:, None], self.blend)
        rgb = first.transmission.masked_scatter(hit[..., None], mixed)
        return rgb, torch.zeros_like(first.transmission).masked_scatter(hit[..., None], reflected)

    def _first_pass(self, scene: Scene, camera: Camera) -> FirstPass:
        near = NEAR_PER_EXTENT * scene.extent
        primary = project_gaussians(scene.primary, camera, near=near)
        glass = project_gaussians(scene.glass, camera, near=near)
        splats = joined_splats(primary, glass)
        bins = bin_tiles(splats, camera.width, camera.height)
        colors = torch.cat([primary.colors, primary.depths[..., None]], dim=-1)
        channels = torch.nn.functional.pad(colors, (0, 0, 0, len(scene.glass)))
        marks = torch.sigmoid(scene.glass.channels["logit_mark"])[None]
        result = composite(splats, channels, bins, marks=marks, num_primary=len(scene.primary))
        alpha = result.alpha[0]
        screen = (
            ScreenPass("primary", primary.means2d, primary.radii),
            ScreenPass("glass", glass.means2d, glass.radii),
        )
        return FirstPass(
            transmission=over_background(result.image[0, ..., :3], alpha, self.background),
            alpha=alpha,
            depth=mean_depth(result.image[0, ..., 3], alpha),
            mask=result.mask[0],
            splats=splats,
            bins=bins,
            screen=screen,
        )

    def _deviation(self, first: FirstPass, hit: Tensor, num_primary: int) -> Tensor:
        """Eq. 14 over the tiles that the hit mask touches."""
        tiles = torch.nonzero(touched_tiles(hit[None]).flatten()).flatten().to(first.bins.active.dtype)
        depth = first.depth if self.deviation_depth_gradient else first.depth.detach()
        bins = first.bins._replace(active=tiles)
        return depth_deviation(first.splats, depth[None].contiguous(), bins, num_primary=num_primary)[0]

    def _second_pass(self, scene: Scene, camera: Camera, planes: Planes, visible: Tensor) -> SecondPass:
        primary = scene.primary if self.reflection_gradient == "all" else detached(scene.primary)
        mirrored_poses = camera.cam_from_world @ mirror_matrices(planes.centers, planes.normals)
        projected = project_gaussians(
            primary,
            camera,
            near=NEAR_PER_EXTENT * scene.extent,
            poses=mirrored_poses,
            clip_planes=half_spaces_of(planes, camera),
        )
        splats = joined_splats(projected)
        bins = bin_tiles(splats, camera.width, camera.height, touched_tiles(visible))
        intensity = torch.exp(primary.channels["log_intensity"]).expand(len(planes), -1)
        channels = torch.cat([projected.colors, intensity[..., None]], dim=-1)
        result = composite(splats, channels, bins)
        images = over_background(result.image[..., :3], result.alpha, self.background)
        shown = visible.to(images.dtype)
        return SecondPass(
            raw_reflection=(images * shown[..., None]).sum(dim=0),
            intensity=(result.image[..., 3] * shown).sum(dim=0),
            screen=ScreenPass("primary", projected.means2d, projected.radii),
        )


def blended(transmission: Tensor, reflection: Tensor, strength: Tensor, blend: Blend) -> Tensor:
    """(1 - R) C_t + R C_r of sRGB colours [P, 3] in the given space, with R [P, 1] (Eq. 1); sRGB.

    Where R is zero the transmission comes back bit for bit.
    """
    if blend == "srgb":
        return transmission + strength * (reflection - transmission)
    behind, reflected = linear_from_srgb(transmission), linear_from_srgb(reflection)
    mixed = srgb_from_linear(behind + strength * (reflected - behind))
    return torch.where(strength > 0, mixed, transmission)


def brightened(color: Tensor, intensity: Tensor, blend: Blend) -> Tensor:
    """sRGB colours [P, 3] times an intensity [P, 1] in the given space (Eq. 13); sRGB."""
    if blend == "srgb":
        return color * intensity
    return srgb_from_linear(linear_from_srgb(color) * intensity)


def select_planes(planes: Planes, index: list[int]) -> Planes:
    """The planes at the given positions."""
    if index == list(range(len(planes))):
        return planes
    chosen = {name: tensor[index] for name, tensor in planes.tensors().items()}
    return replace(planes, **chosen, labels=tuple(planes.labels[k] for k in index))


def detached(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians, cut off from the autograd graph."""
    return gaussians.with_tensors({name: tensor.detach() for name, tensor in gaussians.tensors().items()})


def half_spaces_of(planes: Planes, camera: Camera) -> Tensor:
    """Clip planes [K, 4] that keep each plane's side on which the camera stands; no gradient."""
    with torch.no_grad():
        normals = planes.normals
        side = torch.sign(((camera.center - planes.centers) * normals).sum(-1, keepdim=True))
        facing = normals * side
        return torch.cat([facing, -(facing * planes.centers).sum(-1, keepdim=True)], dim=1)


def touched_tiles(pixels: Tensor) -> Tensor:
    """Tiles [K, rows, columns] bool in which any pixel of the masks [K, H, W] is set."""
    pooled = torch.nn.functional.max_pool2d(pixels[:, None].float(), TILE, ceil_mode=True)
    return pooled[:, 0] > 0
