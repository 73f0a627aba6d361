"""`planar`: Gaussians behind and in front of flat panes (TR-Gaussians)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal, NamedTuple, get_origin, get_type_hints

import torch
from torch import Tensor

from glassplat.kernels import Fresnel
from glassplat.kernels.composite import composite, mean_depth
from glassplat.kernels.panes import layer_derivatives, sample_derivatives
from glassplat.kernels.project import GradientSum
from glassplat.kernels.records import Deviation, PaneHits, Panes, Splats
from glassplat.kernels.tiles import bin_tiles
from glassplat.options import BLACK, Blend, Rgb, check_value
from glassplat.render.frame import (
    NEAR_PER_EXTENT,
    Frame,
    Renderer,
    ScreenPass,
    WithBackground,
    check_colored,
    check_ellipsoids,
    check_numbers,
    concat_absgrad,
    concat_splats,
    over_background,
    project_gaussians,
    screen_pass,
    visible_gaussians,
)
from glassplat.render.panes import (
    CompositedPanes,
    SeenPanes,
    blend_conversions,
    composite_panes,
    nearest_hits,
    own_masks,
    panes_in_camera,
    project_mirrored,
    project_photographer,
    seen_panes,
    tint_of_panes,
    visibilities,
)
from glassplat.render.splat import ellipsoid_normals
from glassplat.scene.camera import Camera
from glassplat.scene.corrections import Exposures
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import nearest_panes
from glassplat.scene.scene import Scene

DEPTH_CHANNEL = 3
"""Channel of the depth in the direct pass, after the colours."""
PHOTOGRAPHED = "photographed"
"""Layer with the photographer in the panes, in addition to an image without."""
PhotographerMode = Literal["absent", "present", "separate"]
"""Modes of rendering the photographer in panes."""
ReflectionGradient = Literal["all", "planes"]
"""Parameters that receive the gradient of the reflection."""


class DirectPass(NamedTuple):
    """The scene as the camera sees it directly, without reflections; see `Planar`."""

    image: Tensor
    alpha: Tensor
    depth: Tensor
    mask: Tensor
    deviation: Tensor | None
    splats: Splats
    marks: Tensor
    visible: Tensor
    screen: tuple[ScreenPass, ...]
    gradient_sum: GradientSum


class MirroredPass(NamedTuple):
    """Mirrored images: colours and intensity minus 1 [K, H, W, 4] of each, and their coverage [K, H, W]."""

    reflections: Tensor
    alpha: Tensor
    visible: Tensor
    screen: tuple[ScreenPass, ...]


@dataclass(frozen=True)
class Planar(WithBackground):
    """Renders transmission, reflection and their blend (TR-Gaussians, Section III-A).

        C = (1 - R) C_t + R C_r                      (Eq. 1)
        R = M sum_k H_k R_k                          (Eqs. 5, 19)
        C_r = C_raw A                                (Eq. 13)

    The direct pass blends the primary Gaussians into C_t and, with the glass Gaussians among them, the mask M (Eq. 7).
    The mirrored pass renders the primary Gaussians of the camera's side through cameras mirrored about each plane. This
    is the same as mirroring the Gaussians (Eqs. 8-12), and is done only in tiles where that pane is visible.

    If there are several panes on a ray, Eq. 1 is applied from the farthest to the nearest: the C_t of a pane is the C
    of the pane behind it (the paper renders only the nearest). The layers R, C_r and C_t are those of the nearest pane
    with a visibility above `LEAST_VISIBILITY`; see `glassplat.render.panes.composite_panes`.

    Layers: `transmission`, `reflection` [H, W, 3]; `strength`, `mask`, `depth`, `alpha` [H, W]; `without_panes` [H, W,
    3], the image without panes. Frames also have `pane` [H, W] int32, the nearest pane, -1 for none; `share` [H, W],
    the share of the image added by all panes; `tint` [H, W, 3], the transmittance of tinted glass; and, if requested,
    `deviation` [H, W] (Eq. 14).

    Photographs also show their photographer in the panes: `Scene.photographer`, Gaussians in a frame that moves with
    the camera. They are only rendered in mirrored images.

    Gradients reach all tensors of the scene and the camera's pose, except R0 of mirrors, and tangents and sizes of
    rectangles, at whose edges the image is discontinuous. Where the intensity is above `DAZZLING`, R_k has none.

    Attributes:
        background: background colour, sRGB.
        fresnel: angular dependence of R_k: a pane with two surfaces, Schlick's approximation for one surface (Eq. 6),
            or none; see `glassplat.kernels.panes.blend_panes`.
        intensity: use the learned intensity a(u); False sets C_r = C_raw.
        reflection_gradient: parameters that receive the gradient of the reflection: all, or only planes.
        deviation: also compute the depth deviation at pixels of panes (Eq. 14), for training.
        deviation_depth_gradient: propagate the deviation's gradient through the mean depth D_t.
        blend: space of Eqs. 1 and 13: linear radiance, or sRGB as in the paper.
        nearest_only: render only the nearest of several panes on a ray, as in the paper.
        photographer: rendering of the photographer in panes: none; in the image and its reflection, for training; or in
            a separate layer `photographed` [H, W, 3].
        separate_mirrored: let the records in `Frame.screen` distinguish mirror images from direct views, with their
            weights; otherwise all count alike.
        normal: also render the layer `normal` [H, W, 3] (`glassplat.render.splat.ellipsoid_normals`).
    """

    fresnel: Fresnel = "pane"
    intensity: bool = True
    reflection_gradient: ReflectionGradient = "all"
    deviation: bool = False
    deviation_depth_gradient: bool = False
    blend: Blend = "linear"
    nearest_only: bool = False
    photographer: PhotographerMode = "absent"
    separate_mirrored: bool = True
    normal: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, hint in _modes().items():
            check_value(hint, getattr(self, name), name)

    def __call__(self, scene: Scene, camera: Camera, *, with_records: bool = False) -> Frame:
        """Renders `scene` from `camera`, on the scene's device.

        Raises:
            ValueError: an intensity, mark or reflectance is missing or cannot be drawn.
        """
        check_panes(scene)
        camera = camera.to(scene.primary.means.device)
        direct, hits, seen = self._find_panes(scene, camera, with_records=with_records)
        layers = {"without_panes": direct.image, "depth": direct.depth, "alpha": direct.alpha, "mask": direct.mask}
        layers["pane"] = hits.pane
        if direct.deviation is not None:
            layers["deviation"] = direct.deviation
        if self.normal:
            layers["normal"] = ellipsoid_normals(scene, camera)
        if seen is None:
            nothing = torch.zeros_like(direct.mask)
            layers |= {"transmission": direct.image, "reflection": torch.zeros_like(direct.image)}
            layers |= {"strength": nothing, "share": nothing}
            return Frame(direct.image, layers, direct.visible, None, direct.screen, background=self.background)
        mirrored = self._mirrored_pass(scene, camera, seen, with_records, direct.gradient_sum)
        masks = self._visibilities(scene, camera, seen, direct)
        result = composite_panes(direct.image, seen, masks, mirrored.reflections, camera, **self._blending)
        if self.photographer == "separate" and len(scene.photographer):
            with_body = replace(self, photographer="present")._mirrored_pass(
                scene, camera, seen, False, direct.gradient_sum
            )
            photographed = composite_panes(direct.image, seen, masks, with_body.reflections, camera, **self._blending)
            layers["photographed"] = photographed.rgb
        layers |= {name: getattr(result, name) for name in ("transmission", "reflection", "strength", "share")}
        if seen.planes.transmittances is not None:
            layers["tint"] = tint_of_panes(seen, masks, seen.planes.transmittances)
        screen = self._screen(direct, mirrored, hits, result) if with_records else ()
        return Frame(result.rgb, layers, direct.visible, mirrored.visible, screen, background=self.background)

    def reflections(
        self, scene: Scene, camera: Camera, backgrounds: Sequence[Rgb], direct: DirectPass | None = None
    ) -> list[Tensor]:
        """The layer `reflection` [H, W, 3] over each of several backgrounds.

        `direct` is the result of `direct_pass`, if available.
        """
        check_panes(scene)
        camera = camera.to(scene.primary.means.device)
        direct, _, seen = self._find_panes(scene, camera, direct=direct)
        if seen is None:
            return [torch.zeros_like(direct.image) for _ in backgrounds]
        mirrored = replace(self, background=BLACK)._mirrored_pass(scene, camera, seen, False, direct.gradient_sum)
        masks = self._visibilities(scene, camera, seen, direct)
        images = (over_background(mirrored.reflections, mirrored.alpha, (*color, 0.0)) for color in backgrounds)
        results = (composite_panes(direct.image, seen, masks, image, camera, **self._blending) for image in images)
        return [result.reflection for result in results]

    def direct_pass(self, scene: Scene, camera: Camera) -> DirectPass:
        """The direct pass, which does not depend on the poses of panes."""
        camera = camera.to(scene.primary.means.device)
        return self._direct_pass(scene, camera, panes_in_camera(scene.planes, camera), False)

    def check(self, scene: Scene) -> None:
        """Raises ValueError if a scene lacks colours, or tensors of its panes, if it has any."""
        check_colored(scene.primary)
        check_ellipsoids(scene.primary)
        check_channels(scene)

    def layers(self, scene: Scene) -> tuple[str, ...]:
        """Names of the layers for display: those of panes only with panes, `photographed` only with a photographer."""
        known = (PHOTOGRAPHED,) if len(scene.photographer) else ()
        panes = ("transmission", "without_panes", "reflection", "strength", "mask") if len(scene.planes) else ()
        return ("rgb", *panes, "normal", "depth", "alpha", *known)

    def with_layers(self, layers: Sequence[str]) -> Planar:
        """The renderer of frames that also have `photographed` and `normal` where they are among the layers."""
        photographer = "separate" if PHOTOGRAPHED in layers else self.photographer
        return replace(self, photographer=photographer, normal=self.normal or "normal" in layers)

    def page_settings(self) -> Mapping[str, Any]:
        """Settings of the web page for panes."""
        return {
            "background": self.background,
            "fresnel": self.fresnel,
            "blend": self.blend,
            "intensity": self.intensity,
            "nearest": self.nearest_only,
        }

    def _find_panes(
        self, scene: Scene, camera: Camera, *, with_records: bool = False, direct: DirectPass | None = None
    ) -> tuple[DirectPass, PaneHits, SeenPanes | None]:
        """The direct pass, the nearest panes, and all visible panes (None if there are none)."""
        rectangles = panes_in_camera(scene.planes, camera)
        direct = self._direct_pass(scene, camera, rectangles, with_records) if direct is None else direct
        hits = nearest_hits(rectangles, camera, direct.mask)
        return direct, hits, seen_panes(scene.planes, camera, hits, direct.mask, most=1 if self.nearest_only else None)

    def _direct_pass(self, scene: Scene, camera: Camera, rectangles: Panes, with_records: bool) -> DirectPass:
        near, gradient_sum = NEAR_PER_EXTENT * scene.extent, GradientSum()
        primary = project_gaussians(scene.primary, camera, near=near, gradient_sum=gradient_sum)
        glass = project_gaussians(scene.glass, camera, near=near)
        splats = concat_splats(primary, glass)
        bins = bin_tiles(splats, camera.width, camera.height)
        channels = torch.cat([primary.colors, primary.depths[..., None]], dim=-1)
        channels = torch.nn.functional.pad(channels, (0, 0, 0, len(scene.glass)))
        marks = torch.sigmoid(scene.glass.channels["logit_mark"])[None]
        deviation = None
        if self.deviation:
            hit = nearest_hits(rectangles, camera).pane >= 0
            deviation = Deviation(DEPTH_CHANNEL, hit.to(channels.dtype)[None], self.deviation_depth_gradient)
        screen = (screen_pass("primary", primary), screen_pass("glass", glass)) if with_records else ()
        result = composite(
            splats,
            channels,
            bins,
            marks=marks,
            num_primary=len(scene.primary),
            deviation=deviation,
            absgrad=concat_absgrad(screen),
        )
        alpha = result.alpha.squeeze(0)
        # Squeezed and split, because indexing an image allocates a gradient of zeros.
        color, depth = result.image.squeeze(0).split((3, 1), dim=-1)
        return DirectPass(
            image=over_background(color.contiguous(), alpha, self.background),
            alpha=alpha,
            depth=mean_depth(depth.squeeze(-1), alpha),
            mask=result.mask.squeeze(0),
            deviation=result.deviation.squeeze(0) if deviation else None,
            splats=splats,
            marks=marks,
            visible=visible_gaussians(primary),
            screen=screen,
            gradient_sum=gradient_sum,
        )

    def _mirrored_pass(
        self, scene: Scene, camera: Camera, seen: SeenPanes, with_records: bool, gradient_sum: GradientSum
    ) -> MirroredPass:
        primary, near = scene.primary, NEAR_PER_EXTENT * scene.extent
        if self.reflection_gradient == "planes":
            primary, gradient_sum = detach_gaussians(scene.primary), GradientSum()
        projected = project_mirrored(primary, camera, seen, near=near, gradient_sum=gradient_sum)
        # As the difference from 1, so that the background has 0 and needs no blending.
        gain = torch.expm1(primary.channels["log_intensity"])[None].expand(len(seen.planes), -1)
        channels = torch.cat([projected.colors, gain[..., None]], dim=-1)
        mirrored = [projected]
        screen: tuple[ScreenPass, ...] = (screen_pass("primary", projected, direct=False),) if with_records else ()
        if self.photographer == "present" and len(scene.photographer):
            body = project_photographer(scene, camera, seen, near=near)
            # The photographer has no intensity, which would be another factor on the colours.
            plain = torch.nn.functional.pad(body.colors, (0, channels.shape[-1] - 3))
            channels = torch.cat([channels, plain], dim=1)
            mirrored.append(body)
            # Densified by mirror images, as no view shows it directly.
            screen += (screen_pass("photographer", body),) if with_records else ()
        splats = concat_splats(*mirrored)
        bins = bin_tiles(splats, camera.width, camera.height, seen.tiles)
        result = composite(splats, channels, bins, absgrad=concat_absgrad(screen))
        reflections = over_background(result.image, result.alpha, (*self.background, 0.0))
        return MirroredPass(reflections, result.alpha, visible_gaussians(projected), screen)

    @property
    def _blending(self) -> dict[str, Any]:
        """Settings of `composite_panes`."""
        return {"fresnel": self.fresnel, "intensity": self.intensity, "blend": self.blend}

    def _screen(
        self, direct: DirectPass, mirrored: MirroredPass, hits: PaneHits, result: CompositedPanes
    ) -> tuple[ScreenPass, ...]:
        """The records of both passes."""
        if self.separate_mirrored:
            return weighted_screen(direct, mirrored, hits, result, self.blend)
        return (*direct.screen, *(replace(record, direct=True) for record in mirrored.screen))

    def _visibilities(self, scene: Scene, camera: Camera, seen: SeenPanes, direct: DirectPass) -> list[Tensor]:
        """[H, W] for each of `seen.order`: how much of that pane is visible."""
        if len(seen.order) == 1:
            return [direct.mask]
        owners = nearest_panes(scene.glass.means, scene.planes)
        own = own_masks(seen, direct.splats, direct.marks, owners, (camera.height, camera.width))
        return visibilities(seen, direct.mask, own)


@cache
def _modes() -> dict[str, Any]:
    """Annotations of the fields of `Planar` that have a few possible values. Evaluated once, because `reflections`
    makes a renderer for each view.
    """
    return {name: hint for name, hint in get_type_hints(Planar).items() if get_origin(hint) is Literal}


LARGEST_LOG = 80.0
"""Maximum of a factor on colours that is finite in single precision."""


def check_channels(scene: Scene) -> None:
    """Raises ValueError if the Gaussians lack a channel that panes need."""
    if len(scene.planes) and "log_intensity" not in scene.primary.channels:
        raise ValueError(
            f"the Gaussians have the channels {sorted(scene.primary.channels)}; expected log_intensity, as "
            "`planar` trains it"
        )
    if "logit_mark" not in scene.glass.channels:
        raise ValueError(f"the glass has the channels {sorted(scene.glass.channels)}; expected logit_mark")


def check_panes(scene: Scene) -> None:
    """Raises ValueError if a tensor for panes is missing or invalid."""
    check_channels(scene)
    check_numbers({"logit_mark": scene.glass.channels["logit_mark"]})
    if len(scene.planes):
        logs = {"log_intensity": scene.primary.channels["log_intensity"]}
        if scene.planes.log_transmittances is not None:
            logs["log_transmittances"] = scene.planes.log_transmittances
        check_numbers(logs, LARGEST_LOG)
        check_numbers({"logit_reflectances": scene.planes.logit_reflectances})


@torch.no_grad()
def weighted_screen(
    direct: DirectPass, mirrored: MirroredPass, hits: PaneHits, result: CompositedPanes, blend: Blend
) -> tuple[ScreenPass, ...]:
    """The records of both passes, weighted by the share of each layer in the image (see `layer_derivatives`).

    Gaussians behind a pane are weighted by the transmission at their centres, mirror images by the root of the mean
    over pixels of panes. With the mean itself, errors of the transmission would count as much in reflections as
    errors of direct views count in these.
    """
    hit = hits.pane >= 0
    layers = result.strength, result.transmission, result.reflection
    through, reflected = layer_derivatives(*layers, hit, linear=blend == "linear")
    primary, glass = direct.screen
    depths = direct.splats.depths[:, : primary.means2d.shape[1]]
    primary = replace(primary, weight=sample_derivatives(through, hits.depth, primary.means2d, depths))
    weight = (reflected.sum() / hit.sum().clamp(min=1)).sqrt()
    return (primary, glass, *(replace(record, weight=weight) for record in mirrored.screen))


def detach_gaussians(gaussians: Gaussians) -> Gaussians:
    """The Gaussians, detached from the autograd graph."""
    return gaussians.with_tensors({name: tensor.detach() for name, tensor in gaussians.tensors().items()})


def with_photographer(renderer: Renderer, photographer: PhotographerMode) -> Renderer:
    """The renderer with this mode for the photographer, if it supports one; see `Planar.photographer`."""
    return replace(renderer, photographer=photographer) if isinstance(renderer, Planar) else renderer


TRUSTED_STRENGTH, DISTRUSTED_STRENGTH = 0.35, 0.65
"""Shares of reflected light between which the photograph is faded into the rendered transmission."""
CLIPPING_BEGINS = 0.96
"""Brightest sRGB channel above which a photograph is increasingly clipped."""
FAINT_LIGHT, PLAIN_LIGHT = 0.01, 0.05
"""Reflected light, of 1, that is harmless and harmful in clipped pixels."""
TRUSTED_PART, DISTRUSTED_PART = 0.3, 0.8
"""Remaining shares of the photographed light between which subtraction becomes unreliable."""
TRUST_WINDOW = 5
"""Pixels over which trust is averaged, against noise."""
DARKEST = 1e-3
"""Added to the photographed light, of 1, before taking shares of it, so that noise in black pixels is a small one."""
DARKEST_GLASS = 0.1
"""Minimum transmittance of tinted glass, so that details and noise are amplified by at most ten."""


def dereflected_photo(
    frame: Frame, photo: Tensor, blend: Blend, *, exposures: Exposures | None = None, name: str = ""
) -> Tensor:
    """The photograph [H, W, 3] uint8 with the reflections of panes removed.

    Solves Eq. 1, C = (1 - R) C_t + R C_r, for C_t from the photographed C and the rendered R and R C_r, so that
    details which the scene lacks survive. The absorption of tinted glass is undone. All panes on a ray are removed:
    C_t is the image without panes, and R and R C_r are their total contribution. The rendered C_t is faded in where
    most of the light is reflected, and where the photograph is clipped by a visible reflection; there, the difference
    would mostly show errors of the rendered reflection. Pixels without panes are unchanged.

    Args:
        frame: a view rendered by `planar`, with `without_panes`, `share`, and `tint` where glass is tinted; on the CPU.
            With the layer `photographed`, the photographer's reflection is removed as well. If there are exposures, it
            also needs `alpha`, because they do not act on the background.
        photo: [H, W, 3] uint8, photograph of that view.
        blend: space of Eq. 1 in the run.
        exposures: exposures of the run's photographs; layers are blended in scene colours. Held-out photographs get the
            mean of their neighbours.
        name: name of this photograph.

    Raises:
        ValueError: photograph and frame differ in size, or an exposure needs the layer `alpha`, which is missing.
    """
    if photo.shape != frame.rgb.shape:
        raise ValueError(f"the photograph is {list(photo.shape)}, the frame {list(frame.rgb.shape)}; expected one size")
    decode, encode = blend_conversions(blend)
    without_panes, share = frame.layers["without_panes"], frame.layers["share"][..., None]
    exposures = exposures.interpolate(name) if exposures and name else Exposures.neutral()
    photographed = photo.to(torch.float32) / 255
    # Clipping is evaluated in the camera's colours, the rest in the scene's.
    clipped = photographed
    change = exposures.change_of(frame.background, name)
    unexposed = 0 if change is None else frame.uncovered[..., None] * change
    photographed = exposures.apply_inverse(photographed + (1 - share) * unexposed, name).clamp(0, 1)
    tint = frame.layers.get("tint", torch.ones((), dtype=torch.float32)).clamp(min=DARKEST_GLASS)
    light, reflected = decode(photographed), decode(frame.photographed) - (1 - share) * tint * decode(without_panes)
    # Trust is almost zero before this division would amplify noise.
    solved = (light - reflected) / ((1 - share).clamp(min=1 - DISTRUSTED_STRENGTH) * tint)
    rendered = decode(without_panes.clamp(0, 1))
    trust = _trust(clipped, light, reflected, share[..., 0])
    behind = rendered + trust[..., None] * (solved - rendered)
    colors = exposures.apply(encode(behind.clamp(0, 1)), name) - unexposed
    pixels = torch.round(colors.clamp(0, 1) * 255).to(torch.uint8)
    return torch.where(share > 0, pixels, photo)


def as_mirror_image(frame: Frame, blend: Blend) -> Tensor:
    """The image [H, W, 3] of the frame with perfect mirrors as panes (R0 = 1), sRGB.

    Needs no rendering: the reflection layer has the mirrored image at full strength. Of several panes on a ray, the
    nearest becomes a mirror; through its border, the others are visible unchanged.

    Args:
        frame: a view rendered by `planar`, with all its layers.
        blend: space of Eq. 1 in the run.
    """
    decode, encode = blend_conversions(blend)
    layers = frame.layers
    share = (layers["mask"] * (layers["strength"] > 0))[..., None]
    behind, mirrored = decode(layers["transmission"]), decode(layers["reflection"])
    return encode(behind + share * (mirrored - behind))


def _trust(photographed: Tensor, light: Tensor, reflected: Tensor, strength: Tensor) -> Tensor:
    """Trust [H, W] in the photograph over the rendered transmission, in [0, 1]."""
    overwhelmed = _smooth_step(strength, TRUSTED_STRENGTH, DISTRUSTED_STRENGTH)
    clipped = _smooth_step(photographed.amax(-1), CLIPPING_BEGINS, 1.0)
    visible = _smooth_step(reflected.amax(-1), FAINT_LIGHT, PLAIN_LIGHT)
    # A small difference of two large values is mostly the error of the rendered one.
    drowned = _smooth_step(reflected.mean(-1) / (light.mean(-1) + DARKEST), TRUSTED_PART, DISTRUSTED_PART)
    trust = (1 - overwhelmed) * (1 - clipped * visible) * (1 - drowned)
    return torch.nn.functional.avg_pool2d(
        trust[None], TRUST_WINDOW, stride=1, padding=TRUST_WINDOW // 2, count_include_pad=False
    )[0]


def _smooth_step(values: Tensor, low: float, high: float) -> Tensor:
    """Smooth step from 0 at `low` to 1 at `high`."""
    share = ((values - low) / (high - low)).clamp(0, 1)
    return share * share * (3 - 2 * share)
