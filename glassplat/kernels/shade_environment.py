"""Deferred shading of an image with what its surfaces mirror."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.cube_lookup import check_cube
from glassplat.kernels.devices import kernels_for
from glassplat.kernels.shaded import Shaded
from glassplat.kernels.tensor_checks import check_tensors


def shade_environment(
    base: Tensor,
    normals: Tensor,
    strength: Tensor,
    texels: Tensor,
    intrinsics: Tensor,
    world_from_cam: Tensor,
    *,
    least_strength: float = 0.0,
) -> Shaded:
    """Adds to every pixel what its surface mirrors of the environment (3DGS-DR, Eq. 3).

        r = 2 (v . n) n - v,    n = N / |N|,    v from the surface to the camera
        E = sigmoid(cube_lookup(texels, r))
        C' = (1 - R) C + R E

    Where N is shorter than `NORMAL_MIN`, as on an empty background, or |R| is below `least_strength`, the image is the
    base, bit for bit, the reflection is 0, and nothing but the base gets a gradient. Where else the strength is 0 the
    image is the base, bit for bit, too, but the strength has its gradient. A normal that is not finite gives NaN.

    Differentiable in `base`, `normals`, `strength` and `texels`.

    Args:
        base: [H, W, 3] C, sRGB.
        normals: [H, W, 3] N, world axes, of any length; the sign does not matter.
        strength: [H, W] R.
        texels: [6, S, S, 3] logits of the environment's sRGB colour, faces as in `cube_lookup`.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        world_from_cam: [3, 3] rotation from camera to world axes; may be mirrored.
        least_strength: pixels that reflect less are left as they are, which saves their lookup.

    Raises:
        ValueError: shapes disagree, or the environment has no texels.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    check_cube(texels)
    height, width = strength.shape
    check_tensors(
        {
            "base": (base, (height, width, 3)),
            "normals": (normals, (height, width, 3)),
            "strength": (strength, (height, width)),
            "texels": (texels, (*texels.shape[:3], 3)),
            "intrinsics": (intrinsics, (4,)),
            "world_from_cam": (world_from_cam, (3, 3)),
        }
    )
    inputs = (base, normals, strength, texels, intrinsics, world_from_cam)
    return Shaded(*_ShadeEnvironment.apply(least_strength, *inputs))


class _ShadeEnvironment(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, least_strength: float, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        inputs = [tensor.detach().contiguous() for tensor in tensors]
        kernels = kernels_for("shade_environment", inputs[0].device)
        rgb, reflection = kernels.shade_environment(inputs, least_strength)
        ctx.least_strength = least_strength
        ctx.save_for_backward(*inputs, reflection)
        return rgb, reflection

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, reflection = ctx.saved_tensors
        cotangents = [gradient.contiguous() for gradient in gradients]
        kernels = kernels_for("shade_environment", reflection.device)
        found = kernels.shade_environment_gradients(inputs, ctx.least_strength, reflection, cotangents)
        return (None, *found, None, None)
