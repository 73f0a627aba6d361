"""Front-to-back blending of splats into images: ellipsoids, with a second transmittance for glass, and discs."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.maths.disc import LOW_PASS, MAP
from glassplat.kernels.records import (
    LEAST_ALPHA,
    MOST_CHANNELS,
    Deviation,
    Discs,
    Splats,
    TileBins,
    check_device,
    check_tensors,
)


def check_bins(channels: Tensor, bins: TileBins, cameras: int, count: int, these: str) -> None:
    """Raises unless bins match the splats or discs, and kernels support the number of channels and the device."""
    check_device("channels", channels, "bins", bins.pair_splats)
    if channels.ndim != 3 or not 1 <= channels.shape[2] <= MOST_CHANNELS:
        raise ValueError(f"channels has shape {list(channels.shape)}, expected [C, G, D] with D in 1..{MOST_CHANNELS}")
    if bins.num_cameras != cameras or len(bins.splat_offsets) != cameras * count + 1:
        raise ValueError(
            f"the bins are for {bins.num_cameras} cameras and {len(bins.splat_offsets) - 1} entries, but there are "
            f"{cameras} cameras with {count} each; bin {these} with bin_tiles"
        )


ABSGRAD, ABSGRAD_OF_DISCS = 7, 5
"""Positions of `absgrad` among the arguments of the two autograd functions."""


class Composite(NamedTuple):
    """Blended images.

    image [C, H, W, D]: sum of channels. alpha [C, H, W]: coverage by primary splats, 1 - T.
    mask [C, H, W]: visible marks of glass splats. deviation [C, H, W]: empty unless requested.
    """

    image: Tensor
    alpha: Tensor
    mask: Tensor
    deviation: Tensor


def composite(
    splats: Splats, channels: Tensor, bins: TileBins,
    *, marks: Tensor | None = None, num_primary: int | None = None, deviation: Deviation | None = None,
    absgrad: Tensor | None = None,
) -> Composite:  # fmt: skip
    """Blends depth-sorted splats over each pixel (3DGS; TR-Gaussians, Eqs. 2, 4, 7 and 13).

        alpha_i = min(0.99, opacity_i exp(-q_i / 2)), ignored below 1/255
        image   = sum over primary i of channels_i alpha_i T_i
        mask    = sum over glass j of marks_j alpha_j T_j T_glass_j
        deviation = where sum over primary i of |z_i - mean z| alpha_i T_i,  mean z = image_z / alpha   (Eq. 14)

    T_i is the product of (1 - alpha) over the primary splats in front, T_glass_j the same over the glass splats in
    front; their product is the transmittance over both together. A pixel stops before the primary splat that would
    reduce T below 1e-4; its mask also stops before the glass splat that would do so to T_glass. All outputs are zero in
    inactive tiles. No background is added.

    Differentiable in `means2d`, `conics`, `opacities`, `channels` and `marks`; the order of depths is constant.
    A non-finite channel makes pixels non-finite only in the tiles that its splat reaches; a splat with non-finite
    geometry is not drawn.

    Args:
        splats: [C, G] splats; those with index >= `num_primary` are glass, and appear in the mask only.
        channels: [C, G, D] values to blend, 1 to 32 of them; those of glass splats are not used.
        bins: the same splats sorted into tiles, from `bin_tiles`.
        marks: [C, G - num_primary] value of each glass splat in the mask, in [0, 1]; required if there is glass.
        num_primary: number of primary splats; all of them by default.
        deviation: the channel z whose deviation to compute, and where; the mean is constant without `through_mean`.
        absgrad: [C, G, 2], values are ignored. Its gradient is the absolute gradient of the centres: |v_x| and |v_y|
            summed over pixels, where the gradient of `means2d` is the signed sum (AbsGS, arXiv 2404.10484, Eq. 8).
            Pixels of opposite sign cancel in the latter but not here.
    """
    cameras, count = splats.opacities.shape
    check_bins(channels, bins, cameras, count, "these very splats")
    num_primary = count if num_primary is None else num_primary
    if not 0 <= num_primary <= count:
        raise ValueError(f"num_primary is {num_primary}, expected between 0 and the {count} splats there are")
    if marks is None:
        if num_primary < count:
            raise ValueError(
                f"{count - num_primary} splats are glass, but there are no marks; pass one per glass splat"
            )
        marks = channels.new_zeros(cameras, 0)
    expected = {
        "means2d": (splats.means2d, (cameras, count, 2)),
        "conics": (splats.conics, (cameras, count, 3)),
        "opacities": (splats.opacities, (cameras, count)),
        "depths": (splats.depths, (cameras, count)),
        "channels": (channels, (cameras, count, channels.shape[2])),
        "marks": (marks, (cameras, count - num_primary)),
    }
    if deviation is not None:
        expected["deviation.where"] = (deviation.where, (cameras, bins.height, bins.width))
        if not 0 <= deviation.channel < channels.shape[2]:
            raise ValueError(f"deviation.channel is {deviation.channel}, but there are {channels.shape[2]} channels")
    if absgrad is not None:
        expected["absgrad"] = (absgrad, (cameras, count, 2))
    check_tensors(expected)
    needs = needs_gradients(*splats[:3], channels, marks, absgrad)
    return Composite(*_Composite.apply(*splats, channels, marks, absgrad, bins, num_primary, deviation, needs))


def needs_gradients(*tensors: Tensor | None) -> bool:
    """Return whether autograd needs the gradient of any of these tensors."""
    return torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in tensors)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *tensors, _, bins, num_primary, deviation, needs = arguments
        *fields, channels, marks = (tensor.detach().contiguous() for tensor in tensors)
        splats = Splats(*fields)
        *outputs, saved = kernels_for("composite", channels.device).composite(
            splats, channels, bins,
            marks=marks, num_primary=num_primary, deviation=deviation, needs_gradients=needs,
        )  # fmt: skip
        ctx.save_for_backward(*splats, channels, marks)
        ctx.bins, ctx.num_primary, ctx.deviation, ctx.saved = bins, num_primary, deviation, saved
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor) -> tuple[Tensor | None, ...]:
        *fields, channels, marks = ctx.saved_tensors
        kernels, with_absgrad = kernels_for("composite", channels.device), ctx.needs_input_grad[ABSGRAD]
        v_means, v_conics, v_opacities, v_values, v_absgrad = kernels.composite_gradients(
            Splats(*fields), channels, ctx.bins, ctx.saved, v_outputs,
            marks=marks, num_primary=ctx.num_primary, deviation=ctx.deviation, with_absgrad=with_absgrad,
        )  # fmt: skip
        v_marks = torch.zeros_like(marks)
        if marks.numel():
            v_marks.copy_(v_values[:, ctx.num_primary :, 0])
            v_values[:, ctx.num_primary :].zero_()
        v_absgrad = v_absgrad if with_absgrad else None
        return v_means, v_conics, v_opacities, None, None, v_values, v_marks, v_absgrad, None, None, None, None


class BlendedDiscs(NamedTuple):
    """Blended images.

    image [C, H, W, D]: sum of channels. alpha [C, H, W]: coverage, 1 - T. depth [C, H, W]: sum of the depths at which
    the pixel's ray meets the discs; over alpha, the expected depth. median [C, H, W]: depth of the last disc in front
    of which T is above 1/2, 0 in empty pixels. distortion [C, H, W]: spread of the blended discs along the ray.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    median: Tensor
    distortion: Tensor


def composite_discs(
    discs: Discs, channels: Tensor, bins: TileBins,
    *, near: float, low_pass: float = LOW_PASS, absgrad: Tensor | None = None,
) -> BlendedDiscs:  # fmt: skip
    """Blends discs over each pixel, ordered by the depths of their centres (2DGS, Eqs. 8 to 13).

        alpha_i = min(0.99, opacity_i exp(-q_i / 2)),  q_i = min(u_i^2 + v_i^2, |d|^2 / low_pass^2)
        image   = sum over i of channels_i alpha_i T_i,  depth = sum over i of z_i alpha_i T_i
        distortion = sum over i < j of w_i w_j (1 / z_i - 1 / z_j)^2,  w_i = alpha_i T_i

    (u, v) is the intersection of the pixel's ray with the disc, in standard deviations, and z its depth; d is the
    offset of the pixel from the disc's centre. If the falloff around the centre is larger, as for a distant or edge-on
    disc, z is the depth of the centre. A disc is cut off where q reaches 9, alpha falls to 1/255, or z is at most
    `near`. A pixel stops before the disc that would reduce T below 1e-4. 2DGS uses NDC depths in the distortion: a
    constant times 1 / z, plus one.

    All outputs are zero in inactive tiles. No background is added. Differentiable in `means2d`, `maps`, `opacities`,
    `depths` and `channels`; the order of depths is constant. A non-finite channel makes pixels non-finite only in the
    tiles that its disc reaches; a disc with non-finite geometry is not drawn.

    Args:
        discs: [C, G] discs, from `project_discs`.
        channels: [C, G, D] values to blend, 1 to 32 of them.
        bins: the outlines of the same discs sorted into tiles, from `bin_tiles`.
        near: as for `project_discs`.
        low_pass: standard deviation in pixels of the falloff around the centre; 0 disables it.
        absgrad: [C, G, 2], values are ignored; as in `composite`, its gradient is the absolute gradient of `means2d`,
            summed over pixels.
    """
    cameras, count = discs.opacities.shape
    check_bins(channels, bins, cameras, count, "the outlines of these very discs")
    expected = {
        "means2d": (discs.means2d, (cameras, count, 2)),
        "maps": (discs.maps, (cameras, count, MAP)),
        "opacities": (discs.opacities, (cameras, count)),
        "depths": (discs.depths, (cameras, count)),
        "channels": (channels, (cameras, count, channels.shape[2])),
        "outlines.means2d": (discs.outlines.means2d, (cameras, count, 2)),
        "outlines.conics": (discs.outlines.conics, (cameras, count, 3)),
    }
    if absgrad is not None:
        expected["absgrad"] = (absgrad, (cameras, count, 2))
    check_tensors(expected)
    if not near >= 0 or not low_pass >= 0:
        raise ValueError(f"near is {near} and low_pass {low_pass}; expected numbers of at least 0")
    needs = needs_gradients(*discs[:4], channels, absgrad)
    return BlendedDiscs(
        *_CompositeDiscs.apply(*discs[:4], channels, absgrad, discs.outlines, bins, near, low_pass, needs)
    )


class _CompositeDiscs(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *tensors, _, outlines, bins, near, low_pass, needs = arguments
        means2d, maps, opacities, depths, channels = (tensor.detach().contiguous() for tensor in tensors)
        plain = Splats(*(tensor.detach().contiguous() for tensor in outlines))
        discs = Discs(means2d, maps, opacities, depths, plain)
        *outputs, saved = kernels_for("composite", channels.device).composite_discs(
            discs, channels, bins, near=near, low_pass=low_pass, needs_gradients=needs
        )
        ctx.save_for_backward(*discs[:4], channels)
        ctx.rest = (plain, bins, saved, near, low_pass)
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor) -> tuple[Tensor | None, ...]:
        means2d, maps, opacities, depths, channels = ctx.saved_tensors
        outlines, bins, saved, near, low_pass = ctx.rest
        found = kernels_for("composite", channels.device).composite_discs_gradients(
            Discs(means2d, maps, opacities, depths, outlines), channels, bins, saved,
            [v.contiguous() for v in v_outputs],
            near=near, low_pass=low_pass, with_absgrad=ctx.needs_input_grad[ABSGRAD_OF_DISCS],
        )  # fmt: skip
        return (*found, None, None, None, None, None)


def mean_depth(depth_sum: Tensor, alpha: Tensor) -> Tensor:
    """Blended depth (TR-Gaussians, Eq. 4): weighted depth sum over total weight; 0 in empty pixels."""
    return torch.where(alpha > LEAST_ALPHA, depth_sum / alpha.clamp(min=LEAST_ALPHA), 0)
