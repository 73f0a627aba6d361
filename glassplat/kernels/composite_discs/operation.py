"""Front-to-back blending of discs (2DGS) into images, depths and their distortion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.maths.disc import LOW_PASS, MAP
from glassplat.kernels.records import MOST_CHANNELS, Discs, Splats, TileBins, check_tensors


class BlendedDiscs(NamedTuple):
    """Blended images.

    image [C, H, W, D]: sum of channels. alpha [C, H, W]: coverage, 1 - T. depth [C, H, W]: sum of the depths at which
    the pixel's ray meets the discs; over alpha, the expected depth. median [C, H, W]: depth of the last disc before
    which more than half of the light is left, 0 where nothing is. distortion [C, H, W]: how far apart along the ray
    lies what the pixel shows.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    median: Tensor
    distortion: Tensor


def composite_discs(
    discs: Discs, channels: Tensor, bins: TileBins,
    *, near: float, low_pass: float = LOW_PASS, probe: Tensor | None = None,
) -> BlendedDiscs:  # fmt: skip
    """Blends discs over each pixel, in the order of their centres' depths (2DGS, Eqs. 8 to 13).

        alpha_i = min(0.99, opacity_i exp(-q_i / 2)),  q_i = min(u_i^2 + v_i^2, |d|^2 / low_pass^2)
        image   = sum over i of channels_i alpha_i T_i,  depth = sum over i of z_i alpha_i T_i
        distortion = sum over i < j of w_i w_j (1 / z_i - 1 / z_j)^2,  w_i = alpha_i T_i

    (u, v) is where the pixel's ray meets the disc, in deviations, and z the depth there; d is the offset of the pixel
    from the disc's centre. Where the falloff around the centre is the larger one, as of a disc far away or seen from
    its edge, z is the depth of the centre. A disc ends where q reaches 9 or alpha 1/255, and where z is at most `near`.
    A pixel stops before the disc that would take T below 1e-4. Depths in NDC, of which 2DGS takes the distortion, are
    1 / z times a constant and plus one.

    Pixels of tiles that are not active are zero everywhere. No background is added. Differentiable in `means2d`,
    `maps`, `opacities`, `depths` and `channels`; the order of depths is constant. A non-finite channel makes pixels
    non-finite only in the tiles that its disc reaches; a disc with non-finite geometry is not drawn.

    Args:
        discs: [C, G] discs, from `project_discs`.
        channels: [C, G, D] values to blend, 1 to 32 of them.
        bins: the outlines of the same discs sorted into tiles, from `bin_tiles`.
        near: of `project_discs`.
        low_pass: standard deviation in pixels of the falloff around the centre; 0 leaves it out.
        probe: [C, G, 2], any values, as in `composite`; its gradient is that of `means2d` with the parts of single
            pixels added up without their signs.

    Raises:
        TypeError: tensors are not all float32 or all float64.
        ValueError: shapes disagree, a number is out of range, or tensors are on different devices.
    """
    _check(discs, channels, bins, probe)
    if not near >= 0 or not low_pass >= 0:
        raise ValueError(f"near is {near} and low_pass {low_pass}; expected numbers of at least 0")
    return BlendedDiscs(*_CompositeDiscs.apply(*discs[:4], channels, probe, discs.outlines, bins, near, low_pass))


def _check(discs: Discs, channels: Tensor, bins: TileBins, probe: Tensor | None) -> None:
    cameras, count = discs.opacities.shape
    if channels.ndim != 3 or not 1 <= channels.shape[2] <= MOST_CHANNELS:
        raise ValueError(f"channels has shape {list(channels.shape)}, expected [C, G, D] with D in 1..{MOST_CHANNELS}")
    expected = {
        "means2d": (discs.means2d, (cameras, count, 2)),
        "maps": (discs.maps, (cameras, count, MAP)),
        "opacities": (discs.opacities, (cameras, count)),
        "depths": (discs.depths, (cameras, count)),
        "channels": (channels, (cameras, count, channels.shape[2])),
        "outlines.means2d": (discs.outlines.means2d, (cameras, count, 2)),
        "outlines.conics": (discs.outlines.conics, (cameras, count, 3)),
    }
    if probe is not None:
        expected["probe"] = (probe, (cameras, count, 2))
    check_tensors(expected)
    if bins.num_cameras != cameras or len(bins.splat_offsets) != cameras * count + 1:
        raise ValueError(
            f"the bins are for {bins.num_cameras} cameras and {len(bins.splat_offsets) - 1} discs, but there are "
            f"{cameras} cameras with {count} discs each; bin the outlines of these very discs with bin_tiles"
        )


def _discs(tensors: Sequence[Tensor], outlines: Splats) -> Discs:
    means2d, maps, opacities, depths = tensors[:4]
    return Discs(means2d, maps, opacities, depths, outlines)


class _CompositeDiscs(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, maps: Tensor, opacities: Tensor, depths: Tensor, channels: Tensor,
        probe: Tensor | None, outlines: Splats, bins: TileBins, near: float, low_pass: float,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        tensors = tuple(tensor.detach().contiguous() for tensor in (means2d, maps, opacities, depths, channels))
        plain = _discs(tensors, Splats(*(tensor.detach().contiguous() for tensor in outlines)))
        kernels = kernels_for("composite_discs", channels.device)
        *outputs, saved = kernels.composite_discs(plain, tensors[4], bins, near=near, low_pass=low_pass)
        ctx.save_for_backward(*tensors)
        ctx.rest = (plain.outlines, bins, saved, near, low_pass)
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor) -> tuple[Tensor | None, ...]:
        channels = ctx.saved_tensors[4]
        outlines, bins, saved, near, low_pass = ctx.rest
        found = kernels_for("composite_discs", channels.device).composite_discs_gradients(
            _discs(ctx.saved_tensors, outlines), channels, bins, saved, [v.contiguous() for v in v_outputs],
            near=near, low_pass=low_pass, probed=ctx.needs_input_grad[5],
        )  # fmt: skip
        return (*found, None, None, None, None)
