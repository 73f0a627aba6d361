"""Terms of the objective, each `(frame, view, scene) -> scalar`."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath

import torch
from torch import Tensor

from glassplat.captures.view import FOLDER, View, in_world, with_ignored_right
from glassplat.kernels.panes import gradient_conflict as shared_edges
from glassplat.kernels.panes import inside_panes
from glassplat.kernels.photometric import photometric
from glassplat.render.deferred import cell_means, cell_side, depth_normals
from glassplat.render.frame import Frame
from glassplat.scene import camera, logit
from glassplat.scene.camera import Camera, to_device
from glassplat.scene.scene import Scene

LossFunction = Callable[[Frame, View, Scene], Tensor | None]


@dataclass(frozen=True)
class LossTerm:
    """A named loss and its weight; the function returns None for a view to which it does not apply."""

    name: str
    weight: float
    function: LossFunction


def weighted_terms(*terms: LossTerm) -> tuple[LossTerm, ...]:
    """The terms whose weight is not zero; the others are not even computed."""
    return tuple(term for term in terms if term.weight != 0)


@dataclass(frozen=True)
class PhotometricLoss:
    """(1 - lambda) L1 + lambda D-SSIM: both from one traversal, with the photograph as bytes.

    Attributes:
        ssim_weight: lambda, in [0, 1]; D-SSIM is 1 - SSIM, window 11, sigma 1.5.
    """

    ssim_weight: float

    def __call__(self, frame: Frame, view: View, scene: Scene) -> Tensor:
        """The loss of a view, in the colours of its photograph; scalar. Ignored pixels count as if they were right."""
        image = with_ignored_right(scene.exposures.apply(frame.rgb, view.name), view)
        found = photometric(image, to_device(view.photo, image.device))
        return found.l1.lerp(1 - found.ssim, self.ssim_weight)


def mean_opacity(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Opacity regularisation L_o (TR-Gaussians, Eq. 20): the L1 norm of the opacities, per Gaussian in view.

    Differentiable in the raw opacities. What no photograph holds up fades until it is relocated. Those that the view
    does not show are left out, unlike in the papers: what few views show would fade in all the others. Mirror images
    do not count: what a pane shows at a tenth of its strength would fade as fast as what is seen directly.
    """
    return _direct_mean(scene.primary.logit_opacities, torch.sigmoid, frame)


def mean_scale(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Covariance regularisation L_Sigma (TR-Gaussians, Eq. 20): the L1 norm of its eigenvalues' roots, per axis.

    Those roots are the standard deviations. Divided by the scene extent, so that the weight does not depend on the
    capture's units. Differentiable in the raw scales. Of what the view shows directly, as `mean_opacity`.
    """
    return _direct_mean(scene.primary.log_scales, torch.exp, frame) / scene.extent


def of_all(term: LossFunction) -> LossFunction:
    """A term of what the view shows directly, as one of all Gaussians."""
    return lambda frame, view, scene: term(replace(frame, direct=None), view, scene)


def _direct_mean(values: Tensor, activation: Callable[[Tensor], Tensor], frame: Frame) -> Tensor:
    """Mean of the activated `values` [N, ...] of what the frame shows directly; of all if it does not say."""
    if frame.direct is None or not camera.waits(values.device):
        chosen = activation(values if frame.direct is None else values[frame.direct])
        return chosen.sum() / max(chosen.numel(), 1)
    # How many there are, only the GPU knows: they are not gathered but all others left out.
    shown = frame.direct.reshape(-1, *[1] * (values.dim() - 1))
    total = torch.where(shown, activation(torch.where(shown, values, 0)), 0).sum()
    return total / (frame.direct.sum() * math.prod(values.shape[1:])).clamp(min=1)


def depth_deviation_loss(frame: Frame, view: View, scene: Scene) -> Tensor:
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


def disc_normals(frame: Frame, view: View, scene: Scene) -> Tensor:
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

    Zero where it is empty. In that layout every operation runs over a contiguous image.
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
"""Size of the photographs for which the paper's weight of L_c was chosen."""
SIZE_POWER = 0.8
"""How L_c shrinks as photographs grow, as a power of their number of pixels: between 0.5, where all slopes are steps
between two pixels, and 1, where all are ramps. Measured on one scene from 100x75 to 800x600: 0.0525, 0.0193, 0.0062,
0.0018."""


CELLS_ACROSS = 36
"""Cells in which shared edges are added up, along the longer side of a photograph."""


def gradient_conflict(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Gradient conflict loss L_c (TR-Gaussians, Eq. 15).

    The image mean of H |grad C_t . sg(grad C_r)|, per colour channel: an edge of the reflection should
    not appear in the transmission. No gradient reaches the reflection. C_t is the image without any pane, also where
    panes are seen through one another. H leaves out the pixels where the reflection ends or passes to another pane's:
    that edge is the pane's own, and the frame behind it has every right to be there.

    Slopes per pixel are steeper in a smaller photograph of the same view. The loss is scaled to what it would be in
    one of `PAPER_PIXELS`, so that one weight serves photographs of any size.
    """
    layers = frame.layers
    inside = inside_panes(layers["pane"], layers["strength"])
    return _size_factor(inside) * shared_edges(layers["without_panes"], layers["reflection"], inside)


def reflection_left(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Edges of the reflection that the transmission still holds: L_c in cells, as far as panes could have left them.

    Counted pixel by pixel, three fifths of L_c are edges that only happen to meet. And where the true edge of something
    behind the glass is in the reflection too, L_c takes it out of the transmission; the reflection grows brighter to
    make up for it, and L_c grows along. So edges are added up in cells first, a cell with more of them than a pane
    could have left counts for nothing (see `gradient_conflict` of `kernels.panes`), and what is brighter than white
    counts as white.
    """
    layers = frame.layers
    inside = inside_panes(layers["pane"], layers["strength"])
    reflection = layers["reflection"].detach().clamp(0, 1)
    cell = max(1, round(max(inside.shape) / CELLS_ACROSS))
    edges = shared_edges(layers["without_panes"], reflection, inside, layers["strength"], cell=cell)
    return _size_factor(inside) * edges


def _size_factor(inside: Tensor) -> float:
    """Factor on slopes shared in a photograph [H, W], as if it had `PAPER_PIXELS`."""
    return float((inside.numel() / PAPER_PIXELS) ** SIZE_POWER)


def _where_counted(errors: Tensor, view: View) -> Tensor:
    """Errors [H, W] that are 0 where the view ignores pixels."""
    return errors if view.ignored is None else errors.masked_fill(to_device(view.ignored, errors.device), 0)


def counted_pixels(view: View, device: torch.device) -> Tensor:
    """[H, W] bool: which pixels the view does not ignore."""
    if view.ignored is None:
        return torch.ones(view.camera.height, view.camera.width, dtype=torch.bool, device=device)
    return ~view.ignored.to(device)


def residual(frame: Frame, view: View, scene: Scene) -> Tensor:
    """[H, W, 3] photograph minus render, sRGB, 0 where the view is ignored."""
    image = scene.exposures.apply(frame.rgb.detach(), view.name)
    difference = view.photo.to(image) / 255 - image
    if view.ignored is not None:
        difference = difference.masked_fill(view.ignored.to(image.device)[..., None], 0)
    return difference


def mask_loss(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Reflection mask loss L_m (TR-Gaussians, Eq. 16), on annotated views only. Ignored pixels count as right."""
    if view.pane_labels is None:
        return None
    annotated = to_device(view.pane_labels > 0, frame.rgb.device).to(frame.rgb.dtype)
    wrong = (frame.layers["mask"] - annotated).abs()
    return _where_counted(wrong, view).mean()


def intensity_departure(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Mean square of log a(u) over the Gaussians: how far reflections are from as bright as what they mirror.

    A dim reflection of a bright thing looks like a bright reflection by a pane of lower R0. Photographs tell the two
    apart by little; this decides where they do not (not in the paper).
    """
    return scene.primary.channels["log_intensity"].square().mean()


@dataclass(frozen=True)
class ReflectanceDeparture:
    """Departure of R0 from that of the glass which is to be expected (not in the paper).

    A darker thing before a pane of higher R0 looks like a brighter one before a pane of lower R0. Photographs tell the
    two apart where they show what is mirrored directly; this decides where none does.

    Attributes:
        reflectance: R0 to expect, between 0 and 1.
    """

    reflectance: float

    def __call__(self, frame: Frame, view: View, scene: Scene) -> Tensor | None:
        """Squares of the difference between logits, of all panes that are no mirrors; None where there is no pane.

        A pane counts by its share of the image, as it does in the photometric loss.
        """
        planes, pane = scene.planes, frame.layers["pane"].flatten()
        if not len(planes):
            return None
        logits = planes.logit_reflectances
        shares = (pane == torch.arange(len(planes), device=pane.device)[:, None]).to(logits.dtype).mean(dim=1)
        return (~planes.are_mirrors * shares * (logits - logit(self.reflectance)).square()).sum()


def tint_departure(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Mean square of the logarithms of the panes' transmittances: how far the glass is from clear (not in the paper).

    Where all that is behind a pane is seen through it, its tint may as well be that of the things.
    """
    logarithms = scene.planes.log_transmittances
    return None if logarithms is None or not len(logarithms) else logarithms.square().mean()


def strength_outside(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Mean reflection strength of the Gaussians outside of the environment's region; None where it has none.

    What only a few views saw looks reflective, because nothing contradicts it, and would spoil the environment.
    """
    if scene.environment.region is None:
        return None
    means = scene.primary.means.detach()
    *center, radius = scene.environment.region
    outside = (means - means.new_tensor(center)).norm(dim=1) > radius
    strengths = torch.sigmoid(scene.primary.channels["logit_strength"])
    return (strengths * outside).sum() / outside.sum().clamp(min=1)


def mean_strength(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Mean reflection strength of all Gaussians: a price, so that what a colour explains as well does not reflect."""
    return torch.sigmoid(scene.primary.channels["logit_strength"]).mean()


log = logging.getLogger("glassplat.training")


@dataclass(frozen=True)
class MonocularNormals:
    """The mean of 1 - n . N_m over the pixels of an image, n the blended normal made unit, N_m the estimated one.

    Pixels without an estimate, that show nothing or that the view ignores count as 0; a view without a file of normals
    has no such term.
    """

    _lacking: set[str] = field(default_factory=set, init=False, repr=False, compare=False)

    def __call__(self, frame: Frame, view: View, scene: Scene) -> Tensor | None:
        """The loss of a view; None where no normals lie next to its photograph."""
        normals = view.normals
        if normals is None:
            folders = view.image_path.parents[: len(PurePosixPath(view.name).parts) + 1]
            if view.name not in self._lacking and any((folder / FOLDER).is_dir() for folder in folders):
                log.warning("no normals for %s in the folder %r next to it: it is learned without", view.name, FOLDER)
            self._lacking.add(view.name)
            return None
        estimated = in_world(to_device(normals, frame.rgb.device).to(frame.rgb), view.camera)
        known = (estimated.square().sum(-1) > 0) & (frame.layers["alpha"].detach() > 0.5)
        blended = torch.nn.functional.normalize(frame.layers["normal"], dim=-1)
        return _where_counted(known * (1 - (blended * estimated).sum(-1)), view).mean()
