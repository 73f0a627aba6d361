"""Deferred shading of blended surfaces with what they mirror."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.cube_lookup import check_cube, cube_lookup
from glassplat.kernels.devices import kernels_for
from glassplat.kernels.pane_hits.reference import ray_grid
from glassplat.kernels.shade_environment.shaded import NORMAL_AT, NORMAL_MIN, STRENGTH_AT, SURFACE_CHANNELS, Shaded
from glassplat.kernels.tensor_checks import check_tensors


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
    """Lays blended surfaces over a background and adds what they mirror of the environment (3DGS-DR, Eq. 3).

        C = blended color + (1 - alpha) background
        r = 2 (v . n) n - v,    n = N / |N|,    v from the surface to the camera
        E = sigmoid(cube_lookup(texels, r))
        C' = (1 - R) C + R E

    Where N is shorter than `NORMAL_MIN`, as on an empty background, or |R| is below `least_strength`, the image is the
    base C, bit for bit, the reflection is 0, and nothing but the base gets a gradient. Where else the strength is 0 the
    image is the base, bit for bit, too, but the strength has its gradient. A normal that is not finite gives NaN.

    Differentiable in `blended`, `alpha`, `texels` and `world_from_cam`.

    Args:
        blended: [H, W, D] with D >= 7: color, sRGB; normal N, world axes, of any length, whose sign does not matter;
            strength R; what follows is not used.
        alpha: [H, W] coverage.
        texels: [6, S, S, 3] logits of the environment's sRGB colour, faces as in `cube_lookup`.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        world_from_cam: [3, 3] rotation from camera to world axes; may be mirrored.
        background: what is seen behind the surfaces, sRGB.
        least_strength: pixels that reflect less are left as they are, which saves their lookup.

    Raises:
        ValueError: shapes disagree, channels are missing, or the environment has no texels.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
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
    inputs = (blended, alpha, texels, intrinsics, world_from_cam, blended.new_tensor(background))
    return Shaded(*_ShadeEnvironment.apply(least_strength, *inputs))


class _ShadeEnvironment(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, least_strength: float, *tensors: Tensor) -> tuple[Tensor, ...]:
        inputs = [tensor.detach().contiguous() for tensor in tensors]
        shaded: Shaded = kernels_for("shade_environment", inputs[0].device).shade_environment(inputs, least_strength)
        ctx.least_strength = least_strength
        ctx.save_for_backward(*inputs, shaded.base, shaded.reflection)
        return tuple(shaded)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, base, reflection = ctx.saved_tensors
        cotangents = [gradient.contiguous() for gradient in gradients]
        kernels = kernels_for("shade_environment", reflection.device)
        found = kernels.shade_environment_gradients(inputs, ctx.least_strength, (base, reflection), cotangents)
        turn = _gradient_of_turn(inputs, ctx.least_strength, cotangents) if ctx.needs_input_grad[5] else None
        return (None, *found, None, turn, None)


def _gradient_of_turn(inputs: list[Tensor], least_strength: float, cotangents: list[Tensor]) -> Tensor:
    """[3, 3] gradient of the camera's rotation, which turns the rays that are mirrored.

    Only cameras that are refined ask for it, so that it has no kernel of its own.
    """
    blended, alpha, texels, intrinsics, world_from_cam, _ = inputs
    normals, strength = blended[..., NORMAL_AT:STRENGTH_AT], blended[..., STRENGTH_AT]
    shines = (normals.square().sum(-1) > NORMAL_MIN**2) & (strength.abs() >= least_strength)
    v_rgb, _, v_reflection = (cotangent[shines] for cotangent in cotangents)
    n, height, width = normals[shines], *alpha.shape
    with torch.enable_grad():
        turn = world_from_cam.detach().requires_grad_()
        rays = ray_grid(intrinsics, width, height)[shines] @ turn.T
        mirrored = n.square().sum(-1, keepdim=True) * rays - 2 * (rays * n).sum(-1, keepdim=True) * n
        seen = torch.sigmoid(cube_lookup(texels, mirrored))
    (found,) = torch.autograd.grad(seen, turn, v_reflection + strength[shines][:, None] * v_rgb)
    return found
