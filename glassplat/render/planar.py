"""`planar`: Gaussians behind and in front of flat panes (TR-Gaussians)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.bin_tiles import bin_tiles
from glassplat.kernels.color_and_depth import color_and_depth
from glassplat.kernels.composite import composite
from glassplat.kernels.fresnel import Fresnel
from glassplat.kernels.join_channels import join_channels
from glassplat.kernels.layer_slopes import layer_slopes, slopes_at
from glassplat.kernels.pane_layers import pane_layers
from glassplat.kernels.panes import PaneHits, Panes
from glassplat.kernels.project import GradientSum
from glassplat.kernels.shade_environment.shaded import SURFACE_CHANNELS
from glassplat.kernels.splats import Deviation, Projected, Splats
from glassplat.kernels.trace import Rays
from glassplat.render.choices import Blend
from glassplat.render.curved import (
    Shades,
    curved_layers,
    mirrored_cameras,
    mirrors_anything,
    shades_of,
    with_matte_layers,
    within_panes,
)
from glassplat.render.frame import Frame, Renderer, ScreenPass, SpacePass
from glassplat.render.glazing import Glazed, glazed, own_masks, visibilities
from glassplat.render.mirror_images import project_mirrored, project_photographer
from glassplat.render.rasterize import (
    NEAR_PER_EXTENT,
    check_colored,
    check_ellipsoids,
    joined_probe,
    joined_splats,
    over_background,
    project_gaussians,
    screen_pass,
    shown,
)
from glassplat.render.seen_panes import (
    SeenPanes,
    glass_owners,
    nearest_hits,
    panes_in_camera,
    seen_panes,
)
from glassplat.render.surface import blended_surface, ellipsoid_channels
from glassplat.render.traced import Traced, space_pass
from glassplat.render.uneven_glass import in_uneven_glass
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene

Shown = Literal["absent", "present", "beside"]
"""Whether panes show who took a photograph."""


class FirstPass(NamedTuple):
    """Everything seen straight through the camera."""

    image: Tensor
    alpha: Tensor
    depth: Tensor
    mask: Tensor
    deviation: Tensor | None
    splats: Splats
    marks: Tensor
    direct: Tensor
    screen: tuple[ScreenPass, ...]
    curved: Shades | None
    total: GradientSum


class SecondPass(NamedTuple):
    """What the panes mirror: colours and intensity minus 1 [K, H, W, 4] of each."""

    reflections: Tensor
    mirrored: Tensor
    screen: tuple[ScreenPass, ...]
    curved: Shades | None


@dataclass(frozen=True)
class Planar:
    """Renders transmission, reflection and their blend (TR-Gaussians, Section III-A).

        C = (1 - R) C_t + R C_r                      (Eq. 1)
        R = M sum_k H_k R_k                          (Eqs. 5, 19)
        C_r = C_raw A                                (Eq. 13)

    The first pass blends the primary Gaussians into C_t and, with the glass Gaussians among them,
    the mask M (Eq. 7). The second pass renders the primary Gaussians of the camera's side through
    cameras mirrored about each plane, which is the same as mirroring the Gaussians (Eqs. 8-12), and
    only in tiles where that pane is seen.

    Where panes are seen through one another, Eq. 1 holds for one after the other, from the farthest on: the C_t of a
    pane is the C of the pane behind it (the paper shows the nearest only). The layers R, C_r and C_t are those of the
    nearest one that is more than `FAINT`ly visible; see `glazing`.

    Layers: `transmission`, `reflection` [H, W, 3]; `strength`, `mask`, `depth`, `alpha` [H, W]; `hit` [H, W], 1 in
    the panes' rectangles, and `inner` [H, W], without the rim of what reflects; `without_panes` [H, W, 3], the image
    were there no panes, and `share` [H, W], how much of what is seen the panes add, all of them together;
    `deviation` [H, W] (Eq. 14) if asked for. With `curved` those of `traced`, of what is seen straight through the
    panes: `base`, `curved_reflection`, `normal` [H, W, 3], `curved_strength` [H, W], and `surroundings` if asked for.

    Curved things may mirror, too: with `curved`, pixels of both passes that show such things are shaded as `traced`
    does, by rays from the place of each that meet the scene's surroundings. So a pane shows what a curved thing
    mirrors; light meets one of each at most.

    A photograph also shows who took it, in the panes: `Scene.photographer`, Gaussians in a frame that goes along with
    the camera. They are drawn among those that a pane mirrors, through the camera mirrored about it, and nowhere else.

    Attributes:
        background: colour behind everything, sRGB.
        fresnel: how R_k rises from R0 at normal incidence: as that of a pane with its two surfaces, by Schlick's curve
            of one surface (Eq. 6), or not at all; see `glassplat.kernels.blend_panes`.
        intensity: use the learned intensity a(u); False sets C_r = C_raw.
        reflection_gradient: what the reflection image's gradient reaches: everything, or the planes alone.
        deviation: also compute the depth deviation where a pane is hit (Eq. 14), for training.
        deviation_depth_gradient: let the deviation's gradient pass through the mean depth D_t.
        blend: space in which Eqs. 1 and 13 hold: linear radiance, where light adds up, or sRGB as in the paper.
        nearest_only: of panes that are seen through one another, show the nearest only, as the paper does.
        photographer: whether panes show the scene's photographer: not, so that the image is what nobody disturbs; in
            the image and its reflection, as photographs do, for training; or in a layer `photographed` [H, W, 3] beside
            the image without.
        tells_mirrored: whether the records of a probed frame tell mirror images from what is seen directly, and how
            much is left of either; if not, all of them count alike.
        curved: how things that are not flat mirror; its background has to be the same. None if nothing does, as in a
            scene in which no such thing has been looked for yet.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fresnel: Fresnel = "pane"
    intensity: bool = True
    reflection_gradient: Literal["all", "planes"] = "all"
    deviation: bool = False
    deviation_depth_gradient: bool = False
    blend: Blend = "linear"
    nearest_only: bool = False
    photographer: Shown = "absent"
    tells_mirrored: bool = True
    curved: Traced | None = None

    def __call__(self, scene: Scene, camera: Camera, *, probed: bool = False) -> Frame:
        """Renders `scene` from `camera`, where the scene's tensors are."""
        if self.curved is not None and not mirrors_anything(scene):
            return with_matte_layers(replace(self, curved=None)(scene, camera, probed=probed))
        camera = camera.to(scene.primary.means.device)
        rectangles = panes_in_camera(scene.planes, camera)
        first = self._first_pass(scene, camera, rectangles, probed)
        layers = {"without_panes": first.image, "depth": first.depth, "alpha": first.alpha, "mask": first.mask}
        if first.curved is not None:
            layers |= curved_layers(first.curved) | self._behind(scene, camera)
        hits = nearest_hits(rectangles, camera, first.mask)
        if first.deviation is not None:
            layers["deviation"] = first.deviation
        seen = seen_panes(scene.planes, camera, hits, first.mask, most=1 if self.nearest_only else None)
        if seen is None:
            nothing = torch.zeros_like(first.mask)
            layers["hit"] = (hits.pane >= 0).to(nothing.dtype)
            layers |= {"transmission": first.image, "reflection": torch.zeros_like(first.image)}
            layers |= {"strength": nothing, "share": nothing, "inner": nothing}
            return Frame(first.image, layers, first.direct, None, first.screen, self._space(scene, probed, first))
        second = self._second_pass(scene, camera, seen, probed, first.total)
        masks = self._visibilities(scene, camera, seen, first)
        result = self._glazed(first, seen, masks, second, camera)
        if self.photographer == "beside" and len(scene.photographer):
            with_body = replace(self, photographer="present")._second_pass(scene, camera, seen, False, first.total)
            layers["photographed"] = self._glazed(first, seen, masks, with_body, camera).rgb
        layers |= {name: getattr(result, name) for name in ("transmission", "reflection", "strength", "share")}
        layers["hit"], layers["inner"] = pane_layers(hits.pane, result.strength)
        screen = self._screen(first, second, hits, result) if probed else ()
        space = self._space(scene, probed, first, second)
        return Frame(result.rgb, layers, first.direct, second.mirrored, screen, space)

    def check(self, scene: Scene) -> None:
        """Raises ValueError where a scene lacks colours, or its panes what they need; there may be no panes."""
        check_colored(scene.primary)
        check_ellipsoids(scene.primary)
        if len(scene.planes) and "log_intensity" not in scene.primary.channels:
            raise ValueError(
                f"the Gaussians have the channels {sorted(scene.primary.channels)}; expected log_intensity, as "
                "`planar` trains it"
            )
        if "logit_mark" not in scene.glass.channels:
            raise ValueError(f"the glass has the channels {sorted(scene.glass.channels)}; expected logit_mark")

    def _first_pass(self, scene: Scene, camera: Camera, rectangles: Panes, probed: bool) -> FirstPass:
        near, total = NEAR_PER_EXTENT * scene.extent, GradientSum()
        primary = project_gaussians(scene.primary, camera, near=near, total=total)
        glass = project_gaussians(scene.glass, camera, near=near)
        splats = joined_splats(primary, glass)
        bins = bin_tiles(splats, camera.width, camera.height)
        channels = self._channels(scene, primary, camera)
        marks = torch.sigmoid(scene.glass.channels["logit_mark"])[None]
        deviation = None
        if self.deviation:
            hit = nearest_hits(rectangles, camera).pane >= 0
            deviation = Deviation(self._depth_at, hit.to(channels.dtype)[None], self.deviation_depth_gradient)
        screen = (screen_pass("primary", primary), screen_pass("glass", glass)) if probed else ()
        result = composite(
            splats,
            channels,
            bins,
            marks=marks,
            num_primary=len(scene.primary),
            deviation=deviation,
            probe=joined_probe(screen),
        )
        alpha = result.alpha.squeeze(0)
        # Squeezed, because the gradient of an indexed image is a whole one of zeros first.
        blended, shades = result.image.squeeze(0), None
        if self.curved is None:
            image, depth = color_and_depth(blended, alpha, self.background)
        else:
            surface = blended_surface(blended, alpha, shown(primary), self.background)
            shades = shades_of(self.curved, scene, [camera], [surface])
            image, depth = shades.images[0], surface.depth
        return FirstPass(
            image=image,
            alpha=alpha,
            depth=depth,
            mask=result.mask.squeeze(0),
            deviation=result.deviation.squeeze(0) if deviation else None,
            splats=splats,
            marks=marks,
            direct=shown(primary),
            screen=screen,
            curved=shades,
            total=total,
        )

    def _behind(self, scene: Scene, camera: Camera) -> dict[str, Tensor]:
        """The layer of what curved things mirror, if asked for."""
        if self.curved is None or not self.curved.surroundings:
            return {}
        return {"surroundings": self.curved.behind(scene, camera)}

    @property
    def _depth_at(self) -> int:
        """Which channel of the first pass is the depth."""
        return 3 if self.curved is None else SURFACE_CHANNELS

    def _channels(self, scene: Scene, projected: Projected, camera: Camera) -> Tensor:
        """[1, G, D] channels of the first pass, of glass too: colours first, and the depth at `_depth_at`."""
        if self.curved is None:
            return join_channels(projected.colors, projected.depths, more=len(scene.glass))
        looks = ellipsoid_channels(scene.primary, projected, camera.center[None])
        return torch.nn.functional.pad(looks, (0, 0, 0, len(scene.glass)))

    def _second_pass(
        self, scene: Scene, camera: Camera, seen: SeenPanes, probed: bool, total: GradientSum
    ) -> SecondPass:
        primary = scene.primary
        if self.reflection_gradient == "planes":
            primary, total = detached(scene.primary), GradientSum()
        projected = project_mirrored(primary, camera, seen, near=NEAR_PER_EXTENT * scene.extent, total=total)
        projected = in_uneven_glass(projected, seen, camera)
        # By how much it departs from 1: what is behind all Gaussians has 0 then, and needs no blending.
        gain = torch.expm1(primary.channels["log_intensity"])[None].expand(len(seen.planes), -1)
        cameras = [] if self.curved is None else mirrored_cameras(camera, seen.planes)
        if self.curved is None:
            channels = join_channels(projected.colors, gain)
        else:
            looks = ellipsoid_channels(primary, projected, torch.stack([each.center for each in cameras]))
            channels = torch.cat([looks, gain[..., None]], dim=-1)
        mirrored = [projected]
        screen: tuple[ScreenPass, ...] = (screen_pass("primary", projected, direct=False),) if probed else ()
        if self.photographer == "present" and len(scene.photographer):
            body = project_photographer(scene, camera, seen, near=NEAR_PER_EXTENT * scene.extent)
            body = in_uneven_glass(body, seen, camera)
            # A body is as bright as it is, and matte: an intensity of its own would be a second factor on its colours.
            plain = torch.nn.functional.pad(body.colors, (0, channels.shape[-1] - 3))
            channels = torch.cat([channels, plain], dim=1)
            mirrored.append(body)
            # No view shows it directly, so that mirror images are what it is densified by.
            screen += (screen_pass("photographer", body),) if probed else ()
        splats = joined_splats(*mirrored)
        bins = bin_tiles(splats, camera.width, camera.height, seen.tiles)
        result = composite(splats, channels, bins, probe=joined_probe(screen))
        if self.curved is None:
            reflections, shades = over_background(result.image, result.alpha, (*self.background, 0.0)), None
        else:
            surfaces = [
                blended_surface(image[..., :-1], alpha, shown(projected), self.background)
                for image, alpha in zip(result.image, result.alpha, strict=True)
            ]
            shades = shades_of(self.curved, scene, cameras, within_panes(surfaces, seen))
            reflections = torch.cat([torch.stack(shades.images), result.image[..., -1:]], dim=-1)
        return SecondPass(reflections, shown(projected), screen, shades)

    def _space(self, scene: Scene, probed: bool, *passes: FirstPass | SecondPass) -> tuple[SpacePass, ...]:
        """What densification reads of the surroundings that curved things mirror."""
        shades = [each.curved for each in passes if each.curved is not None]
        if not probed or not shades or not len(scene.surroundings):
            return ()
        return (space_pass(scene, Rays(*map(torch.cat, zip(*(each.rays for each in shades), strict=True)))),)

    def _glazed(
        self, first: FirstPass, seen: SeenPanes, masks: Sequence[Tensor], second: SecondPass, camera: Camera
    ) -> Glazed:
        """Lays the panes and what they mirror before the image."""
        return glazed(
            first.image,
            seen,
            masks,
            second.reflections,
            camera,
            fresnel=self.fresnel,
            intensity=self.intensity,
            blend=self.blend,
        )

    def _screen(self, first: FirstPass, second: SecondPass, hits: PaneHits, result: Glazed) -> tuple[ScreenPass, ...]:
        """The records of both passes."""
        if self.tells_mirrored:
            return weighted_screen(first, second, hits, result, self.blend)
        return (*first.screen, *(replace(record, direct=True) for record in second.screen))

    def _visibilities(self, scene: Scene, camera: Camera, seen: SeenPanes, first: FirstPass) -> list[Tensor]:
        """[H, W] for each of `seen.order`: how much of that pane is visible."""
        if len(seen.order) == 1:
            return [first.mask]
        owners = glass_owners(scene.glass, scene.planes)
        own = own_masks(seen, first.splats, first.marks, owners, (camera.height, camera.width))
        return visibilities(seen, first.mask, own)


@torch.no_grad()
def weighted_screen(
    first: FirstPass, second: SecondPass, hits: PaneHits, result: Glazed, blend: Blend
) -> tuple[ScreenPass, ...]:
    """The records of both passes, weighted by how much of each layer is left in the image (see `layer_slopes`).

    What is behind a pane counts by what the pane lets through at its centre, mirror images by the mean over the pixels
    that show a pane.
    """
    hit = hits.pane >= 0
    layers = result.strength, result.transmission, result.reflection
    through, mirrored = layer_slopes(*layers, hit, linear=blend == "linear")
    primary, glass = first.screen
    depths = first.splats.depths[:, : primary.means2d.shape[1]]
    primary = replace(primary, weight=slopes_at(through, hits.depth, primary.means2d, depths))
    weight = mirrored.sum() / hit.sum().clamp(min=1)
    return (primary, glass, *(replace(record, weight=weight) for record in second.screen))


def detached(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians, cut off from the autograd graph."""
    return gaussians.with_tensors({name: tensor.detach() for name, tensor in gaussians.tensors().items()})


def with_photographer(renderer: Renderer, photographer: Shown) -> Renderer:
    """A renderer whose frames tell what photographs show, as far as it knows of anybody; see `Planar.photographer`."""
    return replace(renderer, photographer=photographer) if isinstance(renderer, Planar) else renderer
