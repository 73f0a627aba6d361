"""Frames, the results of renderers, and steps shared by rasterising renderers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.utils.weak import WeakIdKeyDictionary

from glassplat.errors import InputError
from glassplat.kernels.project import GradientSum, project
from glassplat.kernels.records import CameraBatch, Projected, ProjectedDiscs, RawGaussians, Splats
from glassplat.options import BLACK, Rgb
from glassplat.scene.camera import Camera, constant
from glassplat.scene.corrections import Exposures
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class ScreenPass:
    """Screen positions of the Gaussians of one scene part, in one rasterisation pass.

    The gradients of a loss with respect to `means2d` and `absgrad`, by `torch.autograd.grad`, are the statistics for
    densification.

    Attributes:
        part: name of the scene part, as in `Scene.gaussian_sets`.
        means2d: [C, N, 2] projected centres, pixels; part of the autograd graph.
        absgrad: [C, N, 2] given to `composite`; its gradient is the absolute gradient of the centres (AbsGS).
        radii: [C, N, 2] half extents in pixels; 0 where not visible.
        weight: of the whole pass or [C, N] of each Gaussian: the share of the drawn light that is left in the image,
            or for mirror images its root; 1, except in and behind panes.
        direct: true for the Gaussians themselves, false for their mirror images.
    """

    part: str
    means2d: Tensor
    absgrad: Tensor
    radii: Tensor
    weight: float | Tensor = 1.0
    direct: bool = True


@dataclass(frozen=True)
class TracedPass:
    """The record of a ray-traced scene part, which has no screen positions, for densification.

    Attributes:
        part: name of the scene part, as in `Scene.gaussian_sets`.
        contributions: [N, 2] given to `trace`; its gradient holds the weights and distances of Gaussians along rays.
    """

    part: str
    contributions: Tensor


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered view and its layers.

    Attributes:
        rgb: [H, W, 3] the image, sRGB, not clamped.
        layers: further images by name, [H, W] or [H, W, 3]; a renderer's docstring lists its own.
        direct: [N] bool, primary Gaussians that are visible directly; None if unknown.
        mirrored: [N] bool, those visible as mirror images; None without reflections.
        screen: one record per rasterised part and pass, if requested by `with_records`.
        traced: one record per traced part, if requested by `with_records`.
        background: the background colour in `rgb`, sRGB.
    """

    rgb: Tensor
    layers: Mapping[str, Tensor] = field(default_factory=dict)
    direct: Tensor | None = None
    mirrored: Tensor | None = None
    screen: tuple[ScreenPass, ...] = ()
    traced: tuple[TracedPass, ...] = ()
    background: Rgb = BLACK

    def __repr__(self) -> str:
        height, width = self.rgb.shape[:2]
        return f"Frame({width}x{height}, layers: {', '.join(self.layers) or 'none'})"

    @property
    def photographed(self) -> Tensor:
        """[H, W, 3] the image as photographed: with the photographer in panes, if rendered."""
        return self.layers.get("photographed", self.rgb)

    def exposed(self, exposures: Exposures, name: str) -> Tensor:
        """[H, W, 3] the image as photographed, in the colours of a photograph; the background keeps its own.

        Differentiable in image, coverage and exposures. Reflections are part of the scene.

        Raises:
            ValueError: the photograph has an exposure, and the frame no layer `alpha`.
        """
        changed = exposures.change_of(self.background, name)
        if changed is None:
            return self.photographed
        reflected = self.layers.get("share", self.layers.get("strength", 0))
        uncovered = (self.uncovered * (1 - reflected))[..., None]
        return torch.addcmul(exposures.apply(self.photographed, name), uncovered, changed, value=-1)

    @property
    def uncovered(self) -> Tensor:
        """[H, W] the share of the background, apart from reflections in front of it.

        Raises:
            ValueError: there is no layer `alpha`.
        """
        if "alpha" not in self.layers:
            raise ValueError(f"the frame has the layers {', '.join(self.layers) or 'none'}; expected alpha among them")
        return 1 - self.layers["alpha"]

    @property
    def visible(self) -> Tensor | None:
        """[N] bool, primary Gaussians visible directly or mirrored; None if unknown."""
        return self.direct if self.direct is None or self.mirrored is None else self.direct | self.mirrored


class Renderer(Protocol):
    """A function from a scene and a camera to a frame."""

    def __call__(self, scene: Scene, camera: Camera, *, with_records: bool = False) -> Frame:
        """Renders `scene` from `camera`; differentiable in every tensor of the scene.

        Args:
            scene: the scene.
            camera: the camera.
            with_records: also make the records for densification, `Frame.screen` and `Frame.traced`; slows down the
                backward pass.
        """
        ...

    def check(self, scene: Scene) -> None:
        """Checks that a scene has everything that the renderer needs.

        Raises:
            ValueError: something is missing; the message names it.
        """
        ...

    def layers(self, scene: Scene) -> tuple[str, ...]:
        """Names of the layers of a scene for display, starting with `rgb`; frames have more for losses."""
        ...

    def with_layers(self, layers: Sequence[str]) -> Renderer:
        """The renderer of frames that also have those of these layers which are rendered only when asked."""
        ...

    def page_settings(self) -> Mapping[str, Any]:
        """Settings with which the web page renders the same."""
        ...


@dataclass(frozen=True)
class WithBackground:
    """Base class of renderers, with the background.

    Attributes:
        background: background colour, sRGB.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if len(self.background) != 3:
            raise ValueError(f"background is {self.background}; expected three numbers, sRGB from 0 to 1")

    def page_settings(self) -> Mapping[str, Any]:
        """Settings of the web page: no panes."""
        return {"background": self.background, "fresnel": "none", "blend": "srgb", "intensity": False}


MEDIAN_DEPTH = "median_depth"
"""Layer that all renderers have for discs."""


def check_layers(renderer: Renderer, scene: Scene, layers: Sequence[str], method: str) -> None:
    """Refuses unknown layers before anything is rendered.

    Raises:
        InputError: a layer is unknown, or no layers are given.
    """
    known = renderer.layers(scene)
    foreign = [layer for layer in layers if layer not in known]
    if foreign or not layers:
        problem = f"renders no layer {', '.join(foreign)}" if foreign else "renders nothing without layers"
        reason = "; the scene has no panes" if method == "planar" and not len(scene.planes) else ""
        if "photographed" in foreign:
            reason += "; only a run trained with --photographer.learn has photographed"
        raise InputError(f"{method} {problem}; expected layers out of {', '.join(known)}{reason}")


NEAR_PER_EXTENT = 0.01
"""Distance of the near plane as a share of the scene extent."""


def project_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    *,
    near: float,
    poses: Tensor | None = None,
    clip_planes: Tensor | None = None,
    windows: Tensor | None = None,
    gradient_sum: GradientSum | None = None,
) -> Projected:
    """Projects a set of Gaussians into one camera, or into several that share its intrinsics.

    Args:
        gaussians: the set to project.
        camera: intrinsics and image size; its pose is used unless `poses` is given.
        near: depth below which a Gaussian is culled, world units.
        poses: [C, 4, 4] `cam_from_world` of the cameras; may be left-handed.
        clip_planes: [C, 4] world planes (n, d); a Gaussian whose centre has n . x + d <= 0 is culled.
        windows: [C, 4] left, top, right and bottom edge of the required part of each image, pixels.
        gradient_sum: shared by all projections of one set whose gradients are summed; see `project`.
    """
    cameras = camera_batch(camera, poses)._replace(clip_planes=clip_planes, windows=windows)
    return project(
        raw_gaussians(gaussians), cameras, sh_degree=gaussians.active_sh_degree, near=near, gradient_sum=gradient_sum
    )


def raw_gaussians(gaussians: Gaussians) -> RawGaussians:
    """The tensors of a set in the form of the kernels."""
    return RawGaussians(gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities, gaussians.sh)


def camera_batch(camera: Camera, poses: Tensor | None = None) -> CameraBatch:
    """A camera in the form of the kernels, or several with its intrinsics at the `poses` [C, 4, 4]."""
    poses = camera.cam_from_world[None] if poses is None else poses
    intrinsics = camera.shared_intrinsics.expand(poses.shape[0], 4).contiguous()
    return CameraBatch(poses, intrinsics, camera.width, camera.height)


def concat_splats(*parts: Projected) -> Splats:
    """One list of splats per camera from several projected sets, in the order given."""
    columns = ([getattr(part, name) for part in parts] for name in Splats._fields)
    return Splats(*(column[0] if len(column) == 1 else torch.cat(column, dim=1) for column in columns))


def visible_gaussians(projected: Projected | ProjectedDiscs) -> Tensor:
    """[N] bool: Gaussians visible in any of the cameras."""
    reached = projected.radii[..., 0] > 0
    return reached[0] if len(reached) == 1 else reached.any(dim=0)


def screen_pass(part: str, projected: Projected | ProjectedDiscs, *, direct: bool = True) -> ScreenPass:
    """The record of a projected scene part, with an `absgrad` that requires a gradient."""
    absgrad = torch.zeros_like(projected.means2d).requires_grad_()
    return ScreenPass(part, projected.means2d, absgrad, projected.radii, direct=direct)


def concat_absgrad(screen: Sequence[ScreenPass]) -> Tensor | None:
    """The `absgrad` [C, G, 2] for `composite`, for parts in this order; None without records."""
    absgrads = [record.absgrad for record in screen]
    return torch.cat(absgrads, dim=1) if len(absgrads) > 1 else next(iter(absgrads), None)


def over_background(image: Tensor, alpha: Tensor, background: tuple[float, ...]) -> Tensor:
    """Adds a constant background [D] behind an image [..., D] with coverage alpha [...]."""
    if not any(background):
        return image
    added: Tensor = _OverBackground.apply(image, alpha, constant(tuple(background), image.dtype, image.device))
    return added


class _OverBackground(torch.autograd.Function):
    """One autograd node instead of four, each of which would traverse the image."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, alpha: Tensor, background: Tensor) -> Tensor:
        ctx.save_for_backward(background)
        return torch.addcmul(image, (1 - alpha)[..., None], background)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor) -> tuple[Tensor, Tensor, None]:
        (background,) = ctx.saved_tensors
        return v_image, -(v_image @ background), None


def check_ellipsoids(gaussians: Gaussians) -> None:
    """Raises ValueError if a set to be splatted as ellipsoids has discs."""
    if gaussians.are_discs:
        raise ValueError("the Gaussians are discs, with two scales; expected three scales, as this method trains them")


def check_colored(gaussians: Gaussians) -> None:
    """Raises ValueError if a visible set has no colours."""
    if gaussians.max_sh_degree < 0:
        raise ValueError("the Gaussians have no colours; expected f_dc_0 to f_dc_2, as every trained splat has them")


_checked_versions: WeakIdKeyDictionary = WeakIdKeyDictionary()
"""Tensors that passed `check_numbers`: the version of their values, and the allowed maximum."""


def check_numbers(values: Mapping[str, Tensor], most: float = math.inf) -> None:
    """Refuses values that would give NaN pixels; invalid shapes of Gaussians are culled individually.

    Tensors that require gradients are not checked: training stops at a non-finite loss instead. Others are checked
    once until they change, because each check synchronises with the GPU.

    Raises:
        ValueError: a value is NaN, infinite or above `most`; the message names the tensor.
    """
    for name, tensor in values.items():
        version = None if tensor.is_inference() else (tensor._version, most)
        if tensor.requires_grad or (version is not None and _checked_versions.get(tensor) == version):
            continue
        if bool((tensor.isfinite() & (tensor <= most)).all()):
            _checked_versions[tensor] = version
        else:
            limit = "" if most == math.inf else f" of at most {most:g}"
            raise ValueError(f"{name} holds values that cannot be drawn; expected finite numbers{limit}")
