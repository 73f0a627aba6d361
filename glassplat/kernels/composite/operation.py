"""Front-to-back blending of splats into images, with a second transmittance for the glass mask."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.composite.inputs import check_splats, primary_count
from glassplat.kernels.records import MOST_CHANNELS, Deviation, Splats, TileBins, check_tensors

PROBE = 7
"""Which argument of the operation the probe is."""


class Composite(NamedTuple):
    """Blended images.

    image [C, H, W, D]: sum of channels. alpha [C, H, W]: coverage by primary splats, 1 - T.
    mask [C, H, W]: visible marks of glass splats. deviation [C, H, W]: empty unless asked for.
    """

    image: Tensor
    alpha: Tensor
    mask: Tensor
    deviation: Tensor


def composite(
    splats: Splats, channels: Tensor, bins: TileBins,
    *, marks: Tensor | None = None, num_primary: int | None = None, deviation: Deviation | None = None,
    probe: Tensor | None = None,
) -> Composite:  # fmt: skip
    """Blends depth-sorted splats over each pixel (3DGS; TR-Gaussians, Eqs. 2, 4, 7 and 13).

        alpha_i = min(0.99, opacity_i exp(-q_i / 2)), ignored below 1/255
        image   = sum over primary i of channels_i alpha_i T_i
        mask    = sum over glass j of marks_j alpha_j T_j T_glass_j
        deviation = where sum over primary i of |z_i - mean z| alpha_i T_i,  mean z = image_z / alpha   (Eq. 14)

    T_i is the product of (1 - alpha) over the primary splats in front, T_glass_j the same over the glass splats in
    front; their product is the transmittance over both together. A pixel stops before the primary splat that would
    take T below 1e-4; its mask also before the glass splat that would take T_glass there. Pixels of tiles that are
    not active are zero everywhere. No background is added.

    Differentiable in `means2d`, `conics`, `opacities`, `channels` and `marks`; the order of depths is constant.
    A non-finite channel makes pixels non-finite only in the tiles that its splat reaches; a splat with non-finite
    geometry is not drawn.

    Args:
        splats: [C, G] splats; those with index >= `num_primary` are glass, and appear in the mask only.
        channels: [C, G, D] values to blend, 1 to 32 of them; those of glass splats are not used.
        bins: the same splats sorted into tiles, from `bin_tiles`.
        marks: [C, G - num_primary] what a glass splat adds to the mask, in [0, 1]; needed where there is glass.
        num_primary: how many splats are primary; all of them by default.
        deviation: the channel z whose deviation to compute, and where; the mean is a constant unless it says so.
        probe: [C, G, 2], any values; they change nothing. Its gradient is how strongly single pixels pull at the
            centres: |v_x| and |v_y|, summed over the pixels, of which the gradient of `means2d` is the sum
            with signs (AbsGS, arXiv 2404.10484, Eq. 8). Pixels that pull against each other show here only.

    Raises:
        TypeError: tensors are not all float32 or all float64.
        ValueError: shapes disagree, glass has no marks, or tensors are on different devices.
    """
    check_splats(splats, bins)
    num_primary = primary_count(num_primary, splats)
    cameras, count = splats.opacities.shape
    if channels.ndim != 3 or not 1 <= channels.shape[2] <= MOST_CHANNELS:
        raise ValueError(f"channels has shape {list(channels.shape)}, expected [C, G, D] with D in 1..{MOST_CHANNELS}")
    if marks is None:
        if num_primary < count:
            raise ValueError(
                f"{count - num_primary} splats are glass, but there are no marks; pass one per glass splat"
            )
        marks = channels.new_zeros(cameras, 0)
    expected = {
        "means2d": (splats.means2d, tuple(splats.means2d.shape)),
        "channels": (channels, (cameras, count, channels.shape[2])),
        "marks": (marks, (cameras, count - num_primary)),
    }
    if deviation is not None:
        expected["deviation.where"] = (deviation.where, (cameras, bins.height, bins.width))
        if not 0 <= deviation.channel < channels.shape[2]:
            raise ValueError(f"deviation.channel is {deviation.channel}, but there are {channels.shape[2]} channels")
    if probe is not None:
        expected["probe"] = (probe, (cameras, count, 2))
    check_tensors(expected)
    needing = [tensor for tensor in (*splats[:3], channels, marks, probe) if tensor is not None]
    needs_gradients = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in needing)
    return Composite(*_Composite.apply(*splats, channels, marks, probe, bins, num_primary, deviation, needs_gradients))


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *tensors, _, bins, num_primary, deviation, needs_gradients = arguments
        *fields, channels, marks = (tensor.detach().contiguous() for tensor in tensors)
        splats = Splats(*fields)
        *outputs, saved = kernels_for("composite", channels.device).composite(
            splats, channels, bins,
            marks=marks, num_primary=num_primary, deviation=deviation, needs_gradients=needs_gradients,
        )  # fmt: skip
        ctx.save_for_backward(*splats, channels, marks)
        ctx.bins, ctx.num_primary, ctx.deviation, ctx.saved = bins, num_primary, deviation, saved
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor) -> tuple[Tensor | None, ...]:
        *fields, channels, marks = ctx.saved_tensors
        kernels = kernels_for("composite", channels.device)
        v_means, v_conics, v_opacities, v_channels, v_marks, v_probe = kernels.composite_gradients(
            Splats(*fields), channels, ctx.bins, ctx.saved, v_outputs,
            marks=marks, num_primary=ctx.num_primary, deviation=ctx.deviation, probed=ctx.needs_input_grad[PROBE],
        )  # fmt: skip
        return v_means, v_conics, v_opacities, None, None, v_channels, v_marks, v_probe, None, None, None, None
