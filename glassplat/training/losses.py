"""Terms of the objective, each `(frame, view, scene) -> scalar`."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import torch
from torch import Tensor

from glassplat.captures.view import NORMALS_FOLDER, View, copy_ignored_pixels, rotate_to_world
from glassplat.kernels import panes as pane_kernels
from glassplat.kernels.photometric import photometric
from glassplat.render.deferred import cell_means, cell_side, depth_normals
from glassplat.render.frame import Frame
from glassplat.scene import camera, logit
from glassplat.scene.camera import Camera, to_device
from glassplat.scene.scene import Scene

log = logging.getLogger("glassplat.training")

LossFunction = Callable[[Frame, View, Scene], Tensor | None]


@dataclass(frozen=True)
class LossTerm:
    """A named loss and its weight; the function returns None for a view to which it does not apply."""

    name: str
    weight: float
    function: LossFunction


def weighted_terms(*terms: LossTerm) -> tuple[LossTerm, ...]:
    """The terms with non-zero weights; the others are not computed."""
    return tuple(term for term in terms if term.weight != 0)


@dataclass(frozen=True)
class PhotometricLoss:
    """(1 - lambda) L1 + lambda D-SSIM: both from one traversal, with the photograph as bytes.

    Attributes:
        ssim_weight: lambda, in [0, 1]; D-SSIM is 1 - SSIM, window 11, sigma 1.5.
    """

    ssim_weight: float

    def __call__(self, frame: Frame, view: View, scene: Scene) -> Tensor:
        """Loss of a view, in the colours of its photograph; scalar. Ignored pixels have no error."""
        image = copy_ignored_pixels(frame.exposed(scene.exposures, view.name), view)
        found = photometric(image, to_device(view.photo, image.device))
        return found.l1.lerp(1 - found.ssim, self.ssim_weight)


def mean_opacity(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Opacity regularisation L_o (TR-Gaussians, Eq. 20): the L1 norm of the opacities, per Gaussian in view.

    Differentiable in the raw opacities. Gaussians that no photograph supports fade until they are relocated. Unlike in
    the papers, Gaussians outside the view are excluded, because those visible in few views would fade in all others.
    Mirror images do not count either: Gaussians visible only in a weak reflection would fade as fast as those seen
    directly.
    """
    return _direct_mean(scene.primary.logit_opacities, torch.sigmoid, frame)


def mean_scale(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Covariance regularisation L_Sigma (TR-Gaussians, Eq. 20): the L1 norm of its eigenvalues' roots, per axis.

    The roots are the standard deviations. They are divided by the scene extent, so that the weight does not depend on
    the capture's units. Differentiable in the raw scales; for Gaussians in view, as `mean_opacity`.
    """
    return _direct_mean(scene.primary.log_scales, torch.exp, frame) / scene.extent


def _direct_mean(values: Tensor, activation: Callable[[Tensor], Tensor], frame: Frame) -> Tensor:
    """Mean of the activated `values` [N, ...] over Gaussians in direct view; over all if visibility is unknown."""
    if frame.direct is None or not camera.synchronises(values.device):
        chosen = activation(values if frame.direct is None else values[frame.direct])
        return chosen.sum() / max(chosen.numel(), 1)
    # Masked instead of gathered, because their number is only known on the GPU.
    shown = frame.direct.reshape(-1, *[1] * (values.dim() - 1))
    total = torch.where(shown, activation(torch.where(shown, values, 0)), 0).sum()
    return total / (frame.direct.sum() * math.prod(values.shape[1:])).clamp(min=1)


def depth_deviation(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Depth variance loss L_d over the hit mask (TR-Gaussians, Eq. 14).

    The image mean of H(u) sum_i |z_i - D_t(u)| w_i, the `deviation` layer, divided by the scene extent so that its
    weight does not depend on the capture's units.
    """
    return frame.layers["deviation"].mean() / scene.extent


def normal_consistency(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Difference of the blended normals from those of the surface that the depths describe (after 2DGS, Eq. 14).

    The mean of 1 - n . n_d over the cells of a coarse grid: n is the mean layer `normal`, made unit, n_d the normal of
    the mean depths. Both have a gradient: where depths are right they turn the normals, and where reflections have
    found the normals, these smooth the surface.
    Cells on an edge of the depth map, or not covered, count as 0.
    """
    from_depth, trusted = depth_normals(frame.layers["depth"], frame.layers["alpha"].detach(), view.camera)
    blended = torch.nn.functional.normalize(cell_means(frame.layers["normal"], cell_side(view.camera)), dim=-1)
    return (trusted.detach() * (1 - (blended * from_depth).sum(-1))).mean()


def distortion(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Depth distortion L_d (2DGS, Eq. 13, in NDC as there): the image mean of sum_{i<j} w_i w_j (m_i - m_j)^2."""
    return frame.layers["distortion"].mean()


def disc_normal_consistency(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Normal consistency L_n (2DGS, Eq. 14): the image mean of sum_i w_i (1 - n_i . N).

    N is the normal of the surface that the expected depths describe, from the pixels left and right, above and below.
    Both sides have a gradient. Pixels on the image's border have no N and are left out.
    """
    inner = slice(1, -1), slice(1, -1)
    from_depth = normals_of_depths(frame.layers["depth"], view.camera)
    to_camera = view.camera.cam_from_world[:3, :3].T.to(frame.layers["normal"])
    blended = (frame.layers["normal"][inner] @ to_camera).unbind(-1)
    agreement = sum(a * b for a, b in zip(blended, from_depth, strict=True))
    return (frame.layers["alpha"][inner] - agreement).mean()


def normals_of_depths(depth: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Unit normals of a depth map [H, W] in camera axes, towards the camera, each coordinate an image [H - 2, W - 2].

    Zero where it is empty. This layout makes all operations contiguous.
    """
    x = (torch.arange(camera.width, dtype=depth.dtype, device=depth.device) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=depth.dtype, device=depth.device) + 0.5 - camera.cy) / camera.fy
    points = depth * x.to(depth), depth * y.to(depth)[:, None], depth
    a_x, a_y, a_z = (p[1:-1, 2:] - p[1:-1, :-2] for p in points)
    d_x, d_y, d_z = (p[2:, 1:-1] - p[:-2, 1:-1] for p in points)
    # In a frame with x to the right, y down and z forward, down x along points to the camera.
    n_x, n_y, n_z = d_y * a_z - d_z * a_y, d_z * a_x - d_x * a_z, d_x * a_y - d_y * a_x
    squared = n_x * n_x + n_y * n_y + n_z * n_z
    inverse = torch.where(squared > 0, squared, torch.inf).rsqrt()
    return n_x * inverse, n_y * inverse, n_z * inverse


PAPER_PIXELS = 960 * 720
"""Size of photographs for which the paper chose the weight of L_c."""
SIZE_POWER = 0.8
"""Exponent by which L_c shrinks with the number of pixels: between 0.5, if all edges are steps, and 1, if all are
ramps. Measured on one scene from 100x75 to 800x600: 0.0525, 0.0193, 0.0062, 0.0018."""
CELLS_ACROSS = 36
"""Cells along the longer side of a photograph, in which shared edges are summed."""


def gradient_conflict(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Gradient conflict loss L_c (TR-Gaussians, Eq. 15).

    The image mean of H |grad C_t . sg(grad C_r)|, per colour channel: an edge of the reflection should not appear in
    the transmission. No gradient reaches the reflection. C_t is the image without any pane, also where panes are seen
    through one another. H excludes pixels at the border of a reflection or between two panes, where the transmission
    may have an edge, too.

    Gradients per pixel are larger in smaller photographs. The loss is scaled to its value at `PAPER_PIXELS`, so that
    one weight suits all sizes.
    """
    layers = frame.layers
    inside = pane_kernels.inside_panes(layers["pane"], layers["strength"])
    return _size_factor(inside) * pane_kernels.gradient_conflict(layers["without_panes"], layers["reflection"], inside)


def cell_gradient_conflict(frame: Frame, view: View, scene: Scene) -> Tensor:
    """L_c in cells: edges of the reflection that remain in the transmission, limited to what panes could have left.

    Pixel by pixel, three fifths of L_c are edges that coincide by chance. If a true edge behind the glass coincides
    with one in the reflection, L_c removes it from the transmission; the reflection becomes brighter to compensate,
    which increases L_c further. Therefore, edges are summed in cells first, cells with more than a pane could have
    left do not count (see `gradient_conflict` of `kernels.panes`), and values are clipped at white.
    """
    layers = frame.layers
    inside = pane_kernels.inside_panes(layers["pane"], layers["strength"])
    reflection = layers["reflection"].detach().clamp(0, 1)
    cell = max(1, round(max(inside.shape) / CELLS_ACROSS))
    edges = pane_kernels.gradient_conflict(layers["without_panes"], reflection, inside, layers["strength"], cell=cell)
    return _size_factor(inside) * edges


def _size_factor(inside: Tensor) -> float:
    """Factor that scales L_c of a photograph [H, W] to `PAPER_PIXELS`."""
    return float((inside.numel() / PAPER_PIXELS) ** SIZE_POWER)


def _without_ignored(errors: Tensor, view: View) -> Tensor:
    """Errors [H, W] that are 0 where the view ignores pixels."""
    return errors if view.ignored is None else errors.masked_fill(to_device(view.ignored, errors.device), 0)


def valid_pixels(view: View, device: torch.device) -> Tensor:
    """[H, W] bool: pixels that the view does not ignore."""
    if view.ignored is None:
        return torch.ones(view.camera.height, view.camera.width, dtype=torch.bool, device=device)
    return ~view.ignored.to(device)


def residual(frame: Frame, view: View, scene: Scene) -> Tensor:
    """[H, W, 3] photograph minus render, sRGB, 0 at ignored pixels."""
    image = frame.exposed(scene.exposures, view.name).detach()
    difference = view.photo.to(image) / 255 - image
    return difference.masked_fill(~valid_pixels(view, image.device)[..., None], 0)


def mask_difference(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Reflection mask loss L_m (TR-Gaussians, Eq. 16), on annotated views only. Ignored pixels have no error."""
    if view.pane_labels is None:
        return None
    annotated = to_device(view.pane_labels > 0, frame.rgb.device).to(frame.rgb.dtype)
    wrong = (frame.layers["mask"] - annotated).abs()
    return _without_ignored(wrong, view).mean()


def intensity_prior(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Mean square of log a(u) over the Gaussians: deviation of reflections from the brightness of what they reflect.

    A dim reflection of a bright object looks like a bright one in a pane of lower R0. Photographs hardly distinguish
    the two; this term resolves the ambiguity (not in the paper).
    """
    return scene.primary.channels["log_intensity"].square().mean()


@dataclass(frozen=True)
class ReflectancePrior:
    """Deviation of R0 from the expected one of glass (not in the paper).

    A dark object reflected by a pane of high R0 looks like a bright one and a low R0. Photographs that show the object
    directly distinguish the two; this term decides if none do.

    Attributes:
        reflectance: expected R0, between 0 and 1.
    """

    reflectance: float

    def __call__(self, frame: Frame, view: View, scene: Scene) -> Tensor | None:
        """Squared differences of logits over all panes except mirrors; None without panes.

        Panes are weighted by their share of the image, as in the photometric loss.
        """
        planes, pane = scene.planes, frame.layers["pane"].flatten()
        if not len(planes):
            return None
        logits = planes.logit_reflectances
        shares = (pane == torch.arange(len(planes), device=pane.device)[:, None]).to(logits.dtype).mean(dim=1)
        return (~planes.are_mirrors * shares * (logits - logit(self.reflectance)).square()).sum()


def tint_prior(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Mean squared logarithm of the panes' transmittances: deviation from clear glass (not in the paper).

    If objects are only visible through a pane, its tint and their colours cannot be distinguished.
    """
    logarithms = scene.planes.log_transmittances
    return None if logarithms is None or not len(logarithms) else logarithms.square().mean()


def strength_outside(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Mean reflection strength of the Gaussians outside the environment's region; None without a region.

    Gaussians that few views see may become reflective, and would corrupt the environment.
    """
    if scene.environment.region is None:
        return None
    outside = ~scene.environment.surrounds(scene.primary.means.detach())
    strengths = torch.sigmoid(scene.primary.channels["logit_strength"])
    return (strengths * outside).sum() / outside.sum().clamp(min=1)


def mean_strength(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Mean reflection strength of all Gaussians: a penalty that prefers plain colours where these suffice."""
    return torch.sigmoid(scene.primary.channels["logit_strength"]).mean()


@dataclass(frozen=True)
class MonocularNormals:
    """The mean of 1 - n . N_m over the pixels of an image, n the blended normal made unit, N_m the estimated one.

    Pixels that are empty, ignored or without an estimate count as 0; views without estimated normals have no such
    term.
    """

    _without_normals: set[str] = field(default_factory=set, init=False, repr=False, compare=False)

    def __call__(self, frame: Frame, view: View, scene: Scene) -> Tensor | None:
        """Loss of a view; None if there are no normals for its photograph."""
        normals, name = view.normals, view.name
        if normals is None:
            folders = view.image_path.parents[: len(PurePosixPath(name).parts) + 1]
            if name not in self._without_normals and any((folder / NORMALS_FOLDER).is_dir() for folder in folders):
                log.warning(
                    "no normals for %s in the folder %r next to it: it is learned without", name, NORMALS_FOLDER
                )
            self._without_normals.add(name)
            return None
        estimated = rotate_to_world(to_device(normals, frame.rgb.device).to(frame.rgb), view.camera)
        known = (estimated.square().sum(-1) > 0) & (frame.layers["alpha"].detach() > 0.5)
        blended = torch.nn.functional.normalize(frame.layers["normal"], dim=-1)
        return _without_ignored(known * (1 - (blended * estimated).sum(-1)), view).mean()
