"""Flat panes: hits of camera rays, blending of transmission and reflection, and edges shared by both."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels import Fresnel
from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.maths.pane import LAWS
from glassplat.kernels.records import BEHIND, BlendedPanes, PaneHits, Panes, check_image, check_tensors


class MirroredViews(NamedTuple):
    """A camera mirrored about K planes.

    poses [K, 4, 4]: `cam_from_world` times the reflection about each plane; left-handed. normals [K, 3]: of the planes,
    unit, in the camera frame. half_spaces [K, 4]: planes (n, d) of the world with n . x + d > 0 on the camera's side.
    """

    poses: Tensor
    normals: Tensor
    half_spaces: Tensor


def mirrored_views(centers: Tensor, raw_normals: Tensor, cam_from_world: Tensor) -> MirroredViews:
    """A camera on a GPU mirrored about planes, in one kernel; see `glassplat.render.panes.mirrored_views`.

    Differentiable in all three; the half spaces have no gradient.

    Args:
        centers: [K, 3] a point on each plane, world units.
        raw_normals: [K, 3] normals of any length.
        cam_from_world: [4, 4].
    """
    expected = {"centers": (centers, (len(centers), 3)), "raw_normals": (raw_normals, (len(centers), 3))}
    check_tensors({**expected, "cam_from_world": (cam_from_world, (4, 4))})
    return MirroredViews(*_MirroredViews.apply(centers, raw_normals, cam_from_world))


class _MirroredViews(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, ...]:
        tensors = [tensor.detach().contiguous() for tensor in inputs]
        poses, normals, half_spaces = kernels_for("panes", tensors[0].device).mirrored_views(*tensors)
        ctx.save_for_backward(*tensors)
        ctx.mark_non_differentiable(half_spaces)
        return poses, normals, half_spaces

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_poses: Tensor, v_normals: Tensor, _: Tensor) -> tuple[Tensor, ...]:
        kernels = kernels_for("panes", v_poses.device)
        found: tuple[Tensor, ...] = kernels.mirrored_views_gradients(
            *ctx.saved_tensors, v_poses.contiguous(), v_normals.contiguous()
        )
        return found


@torch.no_grad()
def panes_in_camera(
    centers: Tensor, raw_normals: Tensor, tangents: Tensor, half_sizes: Tensor, cam_from_world: Tensor
) -> Panes:
    """Rectangles on a GPU in the frame of a camera, in one kernel; see `glassplat.render.panes.panes_in_camera`.

    Args:
        centers: [K, 3] world units.
        raw_normals: [K, 3] of any length.
        tangents: [K, 3] direction of the first side, made orthogonal to the normal.
        half_sizes: [K, 2] along tangent and bitangent.
        cam_from_world: [4, 4].
    """
    rows = {"centers": (centers, 3), "raw_normals": (raw_normals, 3), "tangents": (tangents, 3)}
    expected = {name: (tensor, (len(centers), width)) for name, (tensor, width) in rows.items()}
    check_tensors({**expected, "cam_from_world": (cam_from_world, (4, 4))})
    tensors = (tensor.detach().contiguous() for tensor in (centers, raw_normals, tangents, cam_from_world))
    placed, normals, axes = kernels_for("panes", centers.device).panes_in_camera(*tensors)
    return Panes(placed, normals, axes, half_sizes.detach().contiguous())


@torch.no_grad()
def pane_hits(
    panes: Panes,
    intrinsics: Tensor,
    width: int,
    height: int,
    mask: Tensor | None = None,
    *,
    beyond: PaneHits | None = None,
) -> PaneHits:
    """Finds the nearest pane along the ray of every pixel centre (H_k of TR-Gaussians, Section III-A2).

    Not differentiable; the choice of the pane is piecewise constant.

    Args:
        panes: rectangles in the camera frame, seen from either side.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        width: of the image, pixels.
        height: of the image, pixels.
        mask: [H, W] visibility of the panes; where it is 0, `tiles` and `windows` exclude the pixel.
        beyond: hits with the same panes and camera; the nearest pane behind them is searched for, and none where they
            have none. Called again with its own results, this finds all surfaces along a ray, one after another;
            coplanar panes count as one.
    """
    count = panes.centers.shape[0]
    expected = {
        "centers": (panes.centers, (count, 3)),
        "normals": (panes.normals, (count, 3)),
        "axes": (panes.axes, (count, 2, 3)),
        "half_sizes": (panes.half_sizes, (count, 2)),
        "intrinsics": (intrinsics, (4,)),
    }
    if mask is not None:
        expected["mask"] = (mask, (height, width))
    if beyond is not None:
        expected["beyond.depth"] = (beyond.depth, (height, width))
    check_tensors(expected)
    if beyond is not None:
        check_image("beyond.pane", beyond.pane, torch.int32, "beyond.depth", beyond.depth)
        beyond = beyond._replace(pane=beyond.pane.contiguous(), depth=(beyond.depth * BEHIND).contiguous())
    inputs = [tensor.detach().contiguous() for tensor in (*panes, intrinsics)]
    visible = None if mask is None else mask.detach().contiguous()
    hits: PaneHits = kernels_for("panes", intrinsics.device).pane_hits(inputs, width, height, visible, beyond)
    return hits


def blend_panes(
    transmission: Tensor, mask: Tensor, reflections: Tensor, pane: Tensor,
    normals: Tensor, base_reflectances: Tensor, intrinsics: Tensor,
    *, fresnel: Fresnel = "pane", intensity: bool = True, linear: bool = True,
) -> BlendedPanes:  # fmt: skip
    """Blends transmission and reflection by the strength of each pixel's pane (TR-Gaussians, Section III-A).

        R_k = f(R0, c), c = |n . d|                  (in place of Eq. 6), d the unit ray of the pixel
        R = M R_k                                    (Eqs. 5, 19)
        C_r = C_raw A                                (Eq. 13)
        C = (1 - R) C_t + R C_r                      (Eq. 1)

    f is the reflectance of a real pane for unpolarised light (`fresnel="pane"`). With r0 = R0 / (2 - R0) for one of its
    surfaces and the index n = (1 + sqrt r0) / (1 - sqrt r0), Snell's and Fresnel's laws at one surface are

        c_t = sqrt(1 - (1 - c^2) / n^2)
        r_s = ((c - n c_t) / (c + n c_t))^2,  r_p = ((n c - c_t) / (n c + c_t))^2

    and two surfaces, including multiple reflections between them, reflect

        f = r_s / (1 + r_s) + r_p / (1 + r_p),       which is R0 at c = 1.

    A mirror is a pane whose R0 is near 1.

    Where no pane is shown or the mask is 0, the image is the transmission, bit for bit, and strength and reflection are
    0. The image is also the transmission where the strength is 0.

    Differentiable in `transmission`, `mask`, `reflections`, `normals` and `base_reflectances`. The last two get no
    gradient where A exceeds `DAZZLING`: a lamp's reflection depends on its brightness, and carries no information on
    the pane.

    Args:
        transmission: [H, W, 3] C_t, sRGB.
        mask: [H, W] M, visibility of the panes.
        reflections: [K, H, W, 4] the reflection of each pane: C_raw in sRGB and A - 1, the deviation of the intensity
            from 1, which is 0 where nothing was blended.
        pane: [H, W] int32 index of each pixel's pane, -1 for none, as returned by `pane_hits`.
        normals: [K, 3] unit normals in the camera frame; the sign does not matter.
        base_reflectances: [K] R0 in [0, 1].
        intrinsics: [4] fx, fy, cx, cy in pixels; no gradient.
        fresnel: "pane" is the f above; "schlick" the paper's, f = R0 + (1 - R0) (1 - c)^5 (Eq. 6), of a single surface;
            "none" is f = R0 for every angle.
        intensity: multiply by A; False sets C_r = C_raw.
        linear: blend and multiply linear radiance; False uses sRGB values, as the paper does.
    """
    height, width, count = *mask.shape, normals.shape[0]
    check_tensors(
        {
            "transmission": (transmission, (height, width, 3)),
            "mask": (mask, (height, width)),
            "reflections": (reflections, (count, height, width, 4)),
            "normals": (normals, (count, 3)),
            "base_reflectances": (base_reflectances, (count,)),
            "intrinsics": (intrinsics, (4,)),
        }
    )
    check_image("pane", pane, torch.int32, "mask", mask)
    if fresnel not in LAWS:
        raise ValueError(f"fresnel is {fresnel!r}; expected one of {', '.join(map(repr, LAWS))}")
    switches = (LAWS.index(fresnel), intensity, linear)
    outputs = _BlendPanes.apply(transmission, mask, reflections, normals, base_reflectances, pane, intrinsics, switches)
    return BlendedPanes(*outputs)


class _BlendPanes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *tensors, switches = arguments
        tensors = [tensor.detach().contiguous() for tensor in tensors]
        outputs: tuple[Tensor, ...] = kernels_for("panes", tensors[0].device).blend_panes(tensors, switches)
        ctx.save_for_backward(*tensors)
        ctx.switches = switches
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        inputs, cotangents = ctx.saved_tensors, [gradient.contiguous() for gradient in gradients]
        kernels = kernels_for("panes", cotangents[0].device)
        return (*kernels.blend_panes_gradients(inputs, ctx.switches, cotangents), None, None, None)


@torch.no_grad()
def inside_panes(pane: Tensor, strength: Tensor) -> Tensor:
    """1 where a pixel and its eight neighbours show the same pane, 0 elsewhere. Not differentiable.

    It is also 0 where nothing reflects: on the rim of a pane, and where its rectangle is hit but has no glass.
    Neighbours outside the image are ignored.

    Args:
        pane: [H, W] int32 index of the nearest pane, -1 for none.
        strength: [H, W] of the reflection.

    Returns:
        [H, W], of the type of the strength.
    """
    check_tensors({"strength": (strength, tuple(pane.shape))})
    check_image("pane", pane, torch.int32, "strength", strength)
    inside: Tensor = kernels_for("panes", pane.device).inside_panes(pane.contiguous(), strength.detach().contiguous())
    return inside


@torch.no_grad()
def layer_derivatives(
    strength: Tensor, transmission: Tensor, reflection: Tensor, where: Tensor, *, linear: bool
) -> tuple[Tensor, Tensor]:
    """Derivatives of Eq. 1 of TR-Gaussians by the transmission and by the reflection, for grey layers.

    Each layer is replaced by the mean of its channels. In linear radiance the derivatives are not 1 - R and R: a weak
    reflection stands out from a dark transmission, and reduces its contrast. Not differentiable.

    Args:
        strength: [H, W] R.
        transmission: [H, W, 3] C_t, sRGB.
        reflection: [H, W, 3] C_r, sRGB.
        where: [H, W] bool; elsewhere the derivatives are 1 and 0.
        linear: blend linear radiance; False blends sRGB values, as the paper does.

    Returns:
        Two images [H, W].
    """
    height, width = strength.shape
    shape = (height, width, 3)
    check_tensors(
        {"strength": (strength, shape[:2]), "transmission": (transmission, shape), "reflection": (reflection, shape)}
    )
    check_image("where", where, torch.bool, "strength", strength)
    kernels = kernels_for("panes", strength.device)
    layers = (tensor.detach().contiguous() for tensor in (strength, transmission, reflection, where))
    through, mirrored = kernels.layer_derivatives(*layers, linear=linear)
    return through, mirrored


@torch.no_grad()
def sample_derivatives(derivatives: Tensor, surface: Tensor, means2d: Tensor, depths: Tensor) -> Tensor:
    """Values of an image of derivatives at the centres of splats, 1 in front of a surface. Not differentiable.

    Args:
        derivatives: [H, W] derivatives by the transmission.
        surface: [H, W] depth of the surface, infinite where there is none.
        means2d: [C, N, 2] centres in pixels; those outside the image, and NaN, are clamped to its border.
        depths: [C, N] of the centres.

    Returns:
        [C, N].
    """
    size, leading = tuple(derivatives.shape), tuple(depths.shape)
    expected = {"derivatives": (derivatives, size), "surface": (surface, size), "means2d": (means2d, (*leading, 2))}
    check_tensors({**expected, "depths": (depths, leading)})
    images = (tensor.detach().contiguous() for tensor in (derivatives, surface, means2d, depths))
    found: Tensor = kernels_for("panes", derivatives.device).sample_derivatives(*images)
    return found


def gradient_conflict(
    transmission: Tensor, reflection: Tensor, hit: Tensor, strength: Tensor | None = None, *, cell: int = 1
) -> Tensor:
    """Edges that transmission and reflection share, per colour channel and inner pixel (after TR-Gaussians, Eq. 15).

    With cells of one pixel, and without a strength, this is Eq. 15: the mean of hit |grad C_t . grad C_r|. Larger cells
    use |sum of hit grad C_t . grad C_r|, which is small where edges coincide by chance. With a strength R, a cell's
    weight depends on s, the sum of grad C_t . grad C_r over that of R |grad C_r|^2 in linear light: the part of the
    reflection in the transmission, relative to the light that the pane adds. A residual reflection has s = 1, or 2 if
    the reflection layer has half of its contrast. From s = 2 to 4 the weight falls from 1 to 0, because such an edge
    belongs to the transmission itself.

    Gradients are Sobel's; pixels on the image border are left out. Differentiable in `transmission` only, with constant
    weights: edges of the reflection should not appear in the transmission, but the reflection should not adapt to it.

    Args:
        transmission: [H, W, 3] C_t, with H and W of at least 3.
        reflection: [H, W, 3] C_r.
        hit: [H, W] weight of each pixel, 1 on a pane.
        strength: [H, W] R, the share of the light that is reflected; None weights all cells equally.
        cell: side of the cells, in pixels.
    """
    height, width = hit.shape
    if height < 3 or width < 3:
        raise ValueError(f"the images are {width} x {height} pixels; expected at least 3 x 3 for Sobel derivatives")
    if cell < 1:
        raise ValueError(f"cell is {cell}; expected at least one pixel")
    shape = (height, width, 3)
    check_tensors(
        {"transmission": (transmission, shape), "reflection": (reflection, shape), "hit": (hit, (height, width))}
        | ({} if strength is None else {"strength": (strength, (height, width))})
    )
    mean: Tensor = _GradientConflict.apply(transmission, reflection, hit, strength, cell)
    return mean


class _GradientConflict(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        *images, cell = arguments
        plain = [None if image is None else image.detach().contiguous() for image in images]
        mean: Tensor
        mean, derivatives = kernels_for("panes", images[0].device).gradient_conflict(*plain, cell)
        ctx.save_for_backward(derivatives)
        return mean

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_mean: Tensor) -> tuple[Tensor | None, ...]:
        (derivatives,) = ctx.saved_tensors
        kernels = kernels_for("panes", derivatives.device)
        return kernels.gradient_conflict_gradient(derivatives, v_mean), None, None, None, None
