"""Tracing of rays through Gaussians, front to back, with gradients of both, and its bounding volume hierarchy.

Search: Gaussians are sorted along a Hilbert curve; a leaf bounds eight of them, and a node eight children. The tree
needs no pointers. A search returns the nearest 16 hits (later ones on the CPU: 64) beyond the last known one, and is
repeated from there until the ray stops.

Gradients: the forward pass stores the hits of rays that have few; the backward pass repeats the search for other rays,
with the same code. It sums the rows of each Gaussian in a fixed order: no atomics, the same bits for any number of
threads. `trace` states the definition, which `reference.py` evaluates by testing every ray against every Gaussian.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.maths.disc import MOST_LOG_SCALE
from glassplat.kernels.maths.harmonics import check_sh_degree
from glassplat.kernels.project.reference import rotations, squared_reach, usable, where
from glassplat.kernels.records import (
    FLAT,
    SOLID,
    Bvh,
    RawGaussians,
    Rays,
    Shapes,
    Traced,
    check_tensors,
    expected_shapes,
)


def shapes_of(gaussians: RawGaussians) -> Shapes:
    """Activated shapes; differentiable. With `log_scales` [N, 2] they are discs, with [N, 3] ellipsoids.

    Gaussians without a valid size or orientation, or with a non-finite parameter, become invisible and get no gradient.
    """
    with torch.no_grad():
        valid = usable(gaussians) & gaussians.sh.flatten(1).isfinite().all(dim=1)
        valid &= (gaussians.log_scales.abs() <= MOST_LOG_SCALE).all(dim=1)
    # Placeholders: a NaN masked afterwards would still reach the gradients, as NaN times zero.
    tensors = (where(valid, tensor, torch.ones_like(tensor)) for tensor in gaussians)
    means, quats, log_scales, logit_opacities, sh = tensors
    inverse = torch.exp(-log_scales)
    if log_scales.shape[1] == FLAT:
        inverse = torch.cat([inverse, torch.ones_like(inverse[:, :1])], dim=1)
    opacities = torch.where(valid, torch.sigmoid(logit_opacities), torch.zeros_like(logit_opacities))
    return Shapes(means, rotations(quats).mT * inverse[:, :, None], opacities, sh)


def reach(opacities: Tensor) -> Tensor:
    """Distance [N] in standard deviations up to which rays hit Gaussians; 0 for invisible ones."""
    return squared_reach(opacities).sqrt().nan_to_num()


@torch.no_grad()
def build_bvh(shapes: Shapes, *, flat: bool) -> Bvh:
    """Sorts Gaussians along a space-filling curve, and builds a hierarchy of boxes with eight children per node.

    A Gaussian that no ray can hit, because its opacity is too low or a value is not finite, gets an empty box.

    Args:
        shapes: activated Gaussians, float32 or float64.
        flat: True for discs, False for ellipsoids.
    """
    return kernels_for("trace", shapes.means.device).build_bvh(shapes, flat=flat)


def trace(
    gaussians: RawGaussians, rays: Rays, bvh: Bvh | None = None,
    *, sh_degree: int, near: float, contributions: Tensor | None = None,
) -> Traced:  # fmt: skip
    """Blends the Gaussians that each ray hits, nearest first (EnvGS, Section 4.2 and Eq. 2).

    Gaussians are discs (2DGS) if `log_scales` is [N, 2], hit where the ray crosses their plane, and ellipsoids (3DGS)
    if it is [N, 3], hit where their density along the ray is largest. The coverage is the opacity times the falloff
    there, up to 3 standard deviations from the centre; it is at most 0.99, and zero below 1/255. A ray stops before the
    Gaussian that would reduce its transmittance below 1e-4. Colours are evaluated along the ray, offset by 0.5 and
    clamped at 0; equal distances keep the Gaussians' order.

    Edge-on discs (cosine below 1e-3), Gaussians with a non-finite value, and hits at or before `near` are ignored; rays
    that have zero length or are not finite hit nothing. None of them gets a gradient.

    Differentiable in all tensors of `gaussians`, in origins and in directions (Eqs. 13 and 14, plus the dependence of
    colours on the direction); the same bits for any number of threads.

    Args:
        gaussians: raw tensors, float32 or float64.
        rays: of the same floating-point type.
        bvh: result of `build_bvh` for these Gaussians; built if None.
        sh_degree: highest degree of the spherical harmonics to evaluate; `gaussians.sh` may hold more, or none at all,
            which makes all colours zero.
        near: minimum distance of hits, in multiples of the direction's length, at least 0.
        contributions: [N, 2], values are ignored. Its gradient is each Gaussian's contribution to the rays, independent
            of the loss: the sums of its blending weights, and of these times the distances in world units.
    """
    _check(gaussians, rays, bvh, sh_degree, near, contributions)
    shapes, flat = shapes_of(gaussians), gaussians.log_scales.shape[1] == FLAT
    bvh = build_bvh(shapes, flat=flat) if bvh is None else bvh
    return Traced(
        *_Trace.apply(*shapes, *rays, contributions, bvh, flat, sh_degree if gaussians.sh.shape[1] else -1, near)
    )


def _check(
    gaussians: RawGaussians, rays: Rays, bvh: Bvh | None, sh_degree: int, near: float, contributions: Tensor | None
) -> None:
    count, num_rays = gaussians.means.shape[0], rays.origins.shape[0]
    expected = {
        **expected_shapes(gaussians, FLAT if gaussians.log_scales.shape[1:] == (FLAT,) else SOLID),
        "origins": (rays.origins, (num_rays, 3)),
        "directions": (rays.directions, (num_rays, 3)),
    }
    if bvh is not None:
        expected["boxes"] = (bvh.boxes, tuple(bvh.boxes.shape))
    if contributions is not None:
        expected["contributions"] = (contributions, (count, 2))
    check_tensors(expected)
    if bvh is not None and bvh.order.shape[0] != count:
        raise ValueError(
            f"bvh is over {bvh.order.shape[0]} Gaussians and there are {count}; build it again with build_bvh"
        )
    check_sh_degree(sh_degree, gaussians.sh.shape[1])
    if not near >= 0:
        raise ValueError(f"near is {near}; expected a distance of at least 0")


class _Trace(torch.autograd.Function):
    """The kernels as one node of the autograd graph."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *inputs, _, bvh, flat, degree, near = arguments
        tensors = [tensor.detach().contiguous() for tensor in inputs]
        ctx.options = {"flat": flat, "degree": degree, "near": near}
        outputs: tuple[Tensor, ...] = kernels_for("trace", tensors[0].device).trace(
            tensors[:4], tensors[4:], bvh, **ctx.options, needs_gradients=any(ctx.needs_input_grad)
        )
        ctx.save_for_backward(*tensors, *bvh, *outputs)
        ctx.mark_non_differentiable(outputs[3])
        return outputs[:4]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        shapes, rays, bvh, outputs = saved[:4], saved[4:6], saved[6:9], saved[9:]
        cotangents = [gradient.contiguous() for gradient in gradients[:3]]
        kernels = kernels_for("trace", shapes[0].device)
        found = kernels.trace_gradients(shapes, rays, bvh, outputs, cotangents, **ctx.options)
        return (*found[:6], found[6] if ctx.needs_input_grad[6] else None, None, None, None, None)
