"""Reflective surfaces: their channels, cube-map lookups, and deferred shading with an environment map."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.panes.reference import ray_grid
from glassplat.kernels.records import NORMAL_AT, NORMAL_MIN, STRENGTH_AT, SURFACE_CHANNELS, Shaded, check_tensors


def surface_channels(
    colors: Tensor,
    radii: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    means: Tensor,
    logit_strengths: Tensor,
    camera_center: Tensor,
    extra: Tensor | None = None,
) -> Tensor:
    """Colour, normal and reflection strength of each Gaussian, concatenated (3DGS-DR, Section 3.1).

    The normal is the Gaussian's shortest axis, the first of equally short ones, oriented towards the camera. The choice
    of axis and orientation counts as constant. The normal is 0 if the quaternion is 0 or not finite.

    Differentiable in `colors`, `quats`, `logit_strengths` and `extra`; the length of a quaternion has no effect, and
    its gradient is 0.

    Args:
        colors: [N, 3] of the projected Gaussians, sRGB.
        radii: [N, 2] half extents on screen; a Gaussian with 0 is invisible: its channels and gradients are 0.
        quats: [N, 4] orientations `wxyz` of any length.
        log_scales: [N, 3] logarithm of the standard deviation along each axis.
        means: [N, 3] centres, world units.
        logit_strengths: [N] logit of the reflection strength.
        camera_center: [3] camera centre in the world.
        extra: [N, E] additional channels.

    Returns:
        [N, 7 + E]: colour, unit normal in world axes and strength, as `shade_environment` reads them, then `extra`.
    """
    count = quats.shape[0]
    if extra is None:
        extra = means.new_empty(count, 0)
    check_tensors(
        {
            "colors": (colors, (count, 3)),
            "radii": (radii, (count, 2)),
            "quats": (quats, (count, 4)),
            "log_scales": (log_scales, (count, 3)),
            "means": (means, (count, 3)),
            "logit_strengths": (logit_strengths, (count,)),
            "camera_center": (camera_center, (3,)),
            "extra": (extra, (count, *extra.shape[1:2])),
        }
    )
    channels: Tensor = _SurfaceChannels.apply(
        colors, radii, quats, log_scales, means, logit_strengths, camera_center, extra
    )  # fmt: skip
    return channels


class _SurfaceChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        inputs = [tensor.detach().contiguous() for tensor in tensors]
        channels: Tensor = kernels_for("environment", inputs[0].device).surface_channels(inputs)
        _, radii, quats, log_scales, *_ = inputs
        ctx.save_for_backward(radii, quats, log_scales, channels)
        return channels

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_channels: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        kernels = kernels_for("environment", v_channels.device)
        found = kernels.surface_channels_gradients(saved, v_channels.contiguous())
        v_colors, v_quats, v_logit_strengths, v_extra = found
        return v_colors, None, v_quats, None, None, v_logit_strengths, None, v_extra


def cube_lookup(texels: Tensor, directions: Tensor) -> Tensor:
    """Look up a cube map in given directions, with seamless bilinear filtering.

    Faces are +x, -x, +y, -y, +z, -z. On both faces of axis a (x, y, z = 0, 1, 2), columns run along axis a + 1 and rows
    along a + 2, modulo 3:

        faces       columns towards    rows towards
        +x, -x      +y                 +z
        +y, -y      +z                 +x
        +z, -z      +x                 +y

    A direction d meets the face of its largest coordinate at u = d[a + 1] / |d[a]|, v = d[a + 2] / |d[a]| in [-1, 1];
    texel i has its centre at (2 i + 1) / S - 1. The filter blends the four nearest texels. Across an edge they include
    the neighbouring face's. At a corner of the cube, where only three meet, their mean replaces the fourth. The result
    is continuous everywhere, and equal for both faces at an edge.

    Differentiable in `texels` and `directions`; the gradient of a direction is orthogonal to it.

    Args:
        texels: [6, S, S, D] faces, rows, columns; S of at least 1.
        directions: [..., 3] in the cube's axes, of any positive length. The result is NaN for a direction that is 0,
            NaN or infinite.

    Returns:
        [..., D] blended texels.
    """
    check_cube(texels)
    check_tensors({"texels": (texels, tuple(texels.shape)), "directions": (directions, (*directions.shape[:-1], 3))})
    found: Tensor = _CubeLookup.apply(texels, directions.reshape(-1, 3))
    return found.reshape(*directions.shape[:-1], texels.shape[3])


def check_cube(texels: Tensor) -> None:
    """Raises unless a tensor has the shape of a cube map with texels."""
    shape = tuple(texels.shape)
    if len(shape) != 4 or shape[0] != 6 or shape[1] != shape[2] or shape[1] < 1:
        raise ValueError(f"texels has shape {shape}; expected (6, S, S, D), six square faces of at least one texel")


class _CubeLookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, texels: Tensor, directions: Tensor) -> Tensor:
        inputs = (texels.detach().contiguous(), directions.detach().contiguous())
        ctx.save_for_backward(*inputs)
        found: Tensor = kernels_for("environment", texels.device).cube_lookup(*inputs)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_found: Tensor) -> tuple[Tensor, Tensor]:
        texels, directions = ctx.saved_tensors
        kernels = kernels_for("environment", texels.device)
        gradients: tuple[Tensor, Tensor] = kernels.cube_lookup_gradients(texels, directions, v_found.contiguous())
        return gradients


def shade_environment(
    blended: Tensor,
    alpha: Tensor,
    texels: Tensor,
    intrinsics: Tensor,
    world_from_cam: Tensor,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    least_strength: float = 0.0,
) -> Shaded:
    """Composites blended surfaces over a background and adds their reflection of the environment (3DGS-DR, Eq. 3).

        C = blended color + (1 - alpha) background
        r = 2 (v . n) n - v,    n = N / |N|,    v from the surface to the camera
        E = sigmoid(cube_lookup(texels, r))
        C' = (1 - R) C + R E

    Where N is shorter than `NORMAL_MIN`, as on an empty background, or |R| is below `least_strength`, the image is the
    base C, bit for bit, the reflection is 0, and only the base gets a gradient. At other pixels with a strength of 0
    the image is also the base, bit for bit, but the strength gets its gradient. A non-finite normal gives NaN.

    Differentiable in `blended`, `alpha`, `texels` and `world_from_cam`.

    Args:
        blended: [H, W, D] with D >= 7: color, sRGB; normal N, world axes, of any length and either sign; strength R;
            further channels are not used.
        alpha: [H, W] coverage.
        texels: [6, S, S, 3] logits of the environment's sRGB colour, faces as in `cube_lookup`.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        world_from_cam: [3, 3] rotation from camera to world axes; may be mirrored.
        background: colour behind the surfaces, sRGB.
        least_strength: pixels with a smaller strength are not shaded, which saves their lookup.
    """
    check_cube(texels)
    height, width = alpha.shape
    if blended.ndim != 3 or blended.shape[2] < SURFACE_CHANNELS:
        raise ValueError(
            f"blended has shape {tuple(blended.shape)}; expected (H, W, D) with color, normal and strength in "
            f"the first {SURFACE_CHANNELS} channels"
        )
    check_tensors(
        {
            "blended": (blended, (height, width, blended.shape[2])),
            "alpha": (alpha, (height, width)),
            "texels": (texels, (*texels.shape[:3], 3)),
            "intrinsics": (intrinsics, (4,)),
            "world_from_cam": (world_from_cam, (3, 3)),
        }
    )
    behind = _color(tuple(background), blended.dtype, blended.device)
    inputs = (blended, alpha, texels, intrinsics, world_from_cam, behind)
    return Shaded(*_ShadeEnvironment.apply(least_strength, *inputs))


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _color(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """The numbers as a cached tensor, filled on the device, because copying from the host would stall it."""
    color = torch.empty(len(values), dtype=dtype, device=device)
    for part, value in zip(color, values, strict=True):
        part.fill_(value)
    return color


class _ShadeEnvironment(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, least_strength: float, *tensors: Tensor) -> tuple[Tensor, ...]:
        inputs = [tensor.detach().contiguous() for tensor in tensors]
        shaded: Shaded = kernels_for("environment", inputs[0].device).shade_environment(inputs, least_strength)
        ctx.least_strength = least_strength
        ctx.save_for_backward(*inputs, shaded.base, shaded.reflection)
        return tuple(shaded)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, base, reflection = ctx.saved_tensors
        cotangents = [gradient.contiguous() for gradient in gradients]
        kernels = kernels_for("environment", reflection.device)
        found = kernels.shade_environment_gradients(inputs, ctx.least_strength, (base, reflection), cotangents)
        v_rotation = _rotation_gradient(inputs, ctx.least_strength, cotangents) if ctx.needs_input_grad[5] else None
        return (None, *found, None, v_rotation, None)


def _rotation_gradient(inputs: list[Tensor], least_strength: float, cotangents: list[Tensor]) -> Tensor:
    """Gradient [3, 3] of the camera's rotation, which rotates the reflected rays.

    Only the refinement of cameras needs it, so it has no kernel of its own.
    """
    blended, alpha, texels, intrinsics, world_from_cam, _ = inputs
    normals, strength = blended[..., NORMAL_AT:STRENGTH_AT], blended[..., STRENGTH_AT]
    shines = (normals.square().sum(-1) > NORMAL_MIN**2) & (strength.abs() >= least_strength)
    v_rgb, _, v_reflection = (cotangent[shines] for cotangent in cotangents)
    n, height, width = normals[shines], *alpha.shape
    with torch.enable_grad():
        rotation = world_from_cam.detach().requires_grad_()
        rays = ray_grid(intrinsics, width, height)[shines] @ rotation.T
        mirrored = n.square().sum(-1, keepdim=True) * rays - 2 * (rays * n).sum(-1, keepdim=True) * n
        seen = torch.sigmoid(cube_lookup(texels, mirrored))
    (found,) = torch.autograd.grad(seen, rotation, v_reflection + strength[shines][:, None] * v_rgb)
    return found
