"""Rasterisation with the signature of gsplat, so that programs written for it also run on CPUs."""

from __future__ import annotations

from operator import index
from typing import Any, Literal

import torch
from torch import Tensor

from glassplat.errors import InputError
from glassplat.kernels.composite import MOST_CHANNELS, composite
from glassplat.kernels.maths.blending import ALPHA_MIN
from glassplat.kernels.maths.projection import LOW_PASS
from glassplat.kernels.project import project
from glassplat.kernels.records import TILE, CameraBatch, Projected, RawGaussians, Splats, TileBins
from glassplat.kernels.tiles import bin_tiles, tile_grid

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
LEAST_SCALE = 1e-20
"""Minimum standard deviation, world units: that of a line or a point has no logarithm."""
LEAST_ALPHA = 1e-10
"""Minimum divisor of depths, as in gsplat."""
ANYWHERE = 1e9
"""Edges of a window that culls nothing, in pixels."""


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = MOST_CHANNELS,
    distributed: bool = False,
    camera_model: Literal["pinhole"] = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians into cameras, with the signature of `gsplat.rasterization`, on the CPU or on CUDA.

    Differentiable in the Gaussians, `viewmats` and `backgrounds`, not in `Ks`. Coverage is cut off at 0.99 and below
    1/255, as in 3DGS and gsplat's main branch (its release 1.5.3 cuts off at 0.999). Gradients of `viewmats` equal
    gsplat's along rigid motions; for view directions, gsplat inverts them as general matrices.

    Args:
        means: [N, 3] centres, world units.
        quats: [N, 4] wxyz, of any length.
        scales: [N, 3] standard deviations, world units.
        opacities: [N] in [0, 1].
        colors: [N, D] or [C, N, D] values of any kind; with `sh_degree`, [N, K, 3] or [C, N, K, 3] coefficients.
        viewmats: [C, 4, 4] world to camera, OpenCV axes.
        Ks: [C, 3, 3] pinhole intrinsics, pixels.
        width: width of the images, pixels.
        height: height of the images, pixels.
        near_plane: minimum depth.
        far_plane: maximum depth.
        radius_clip: Gaussians with a radius up to this, in pixels, are culled.
        eps2d: variance added on screen, px^2.
        sh_degree: SH degree to use, up to 3.
        packed: ignored; results are not packed.
        tile_size: ignored.
        backgrounds: [C, D] background values; none for depths.
        render_mode: `D` is the depth weighted by coverage, `ED` the expected depth; it comes after the colours.
        sparse_grad: must be False.
        absgrad: `loss.backward()` sets `meta["means2d"].absgrad`, [C, N, 2], if shapes or cameras require gradients.
        rasterize_mode: `antialiased` compensates opacities for the widening by `eps2d`.
        channel_chunk: number of channels blended at once, at most 32.
        distributed: must be False.
        camera_model: must be `pinhole`.
        segmented: ignored.
        covars: must be None.
        others: further options of gsplat, which must be off.

    Returns:
        [C, height, width, X] colours, depths or both; [C, height, width, 1] coverage; and a dictionary with `means2d`
        [C, N, 2] (on which `retain_grad` may be called before the backward pass), `radii` [C, N, 2] int32, `depths`,
        `conics`, `opacities`, sizes, and None for keys of packed results.

    Raises:
        InputError: an option is not supported, or a shape is wrong.
        ValueError, TypeError: shapes, types or devices of tensors do not match.
    """
    on = {"sparse_grad": sparse_grad, "distributed": distributed, "covars": covars is not None} | {
        name: value is not None and value is not False for name, value in others.items()
    }
    _check_options(render_mode, rasterize_mode, camera_model, [name for name, is_on in on.items() if is_on])
    width, height = index(width), index(height)
    cameras = CameraBatch(viewmats, _intrinsics(viewmats, Ks), width, height)
    if eps2d > LOW_PASS:
        edges = viewmats.new_tensor([-ANYWHERE, -ANYWHERE, ANYWHERE, ANYWHERE])
        cameras = cameras._replace(windows=edges.expand(len(viewmats), 4).contiguous())
    _check_colors(colors, means, viewmats, sh_degree)
    projected = _project(means, quats, scales, opacities, colors, cameras, sh_degree=sh_degree, near=near_plane)
    splats = _splats(projected, opacities, eps2d, antialiased=rasterize_mode == "antialiased")
    seen = (splats.depths < far_plane) & (splats.radii > radius_clip).any(dim=-1)
    if eps2d > LOW_PASS:
        size = splats.means2d.new_tensor([width, height])
        seen &= ((splats.means2d + splats.radii > 0) & (splats.means2d - splats.radii < size)).all(dim=-1)
    splats = splats._replace(radii=torch.where(seen[..., None], splats.radii, 0))
    shown = projected.colors if sh_degree is not None else colors.expand(len(viewmats), *colors.shape[-2:])
    depths = splats.depths[..., None]
    channels = {"RGB": shown, "D": depths, "ED": depths}.get(render_mode)
    bins = bin_tiles(splats, width, height)
    image, alpha = _blend(
        splats,
        torch.cat([shown, depths], dim=-1) if channels is None else channels,
        bins,
        chunk=min(channel_chunk, MOST_CHANNELS),
        with_absgrad=absgrad,
    )
    image = _finish(image, alpha, backgrounds, render_mode)
    return image, alpha, _meta(splats, width, height)


def _check_options(render_mode: str, rasterize_mode: str, camera_model: str, on: list[str]) -> None:
    if render_mode not in RENDER_MODES:
        raise InputError(f"render_mode is {render_mode!r}; expected one of {', '.join(RENDER_MODES)}")
    if rasterize_mode not in ("classic", "antialiased"):
        raise InputError(f"rasterize_mode is {rasterize_mode!r}; expected classic or antialiased")
    if camera_model != "pinhole":
        raise InputError(f"camera_model is {camera_model!r}; expected pinhole, the only supported one")
    if on:
        raise InputError(f"rasterization has no {', '.join(on)} here; it supports this signature only")


def _check_colors(colors: Tensor, means: Tensor, viewmats: Tensor, sh_degree: int | None) -> None:
    count, cameras = len(means), len(viewmats)
    last = 1 if sh_degree is None else 2
    if colors.ndim > last and tuple(colors.shape[:-last]) in ((count,), (cameras, count)):
        return
    expected = "[N, D] or [C, N, D]" if sh_degree is None else "[N, K, 3] or [C, N, K, 3] with sh_degree"
    raise InputError(
        f"colors has shape {list(colors.shape)}; expected {expected}, for N = {count} Gaussians and C = {cameras} "
        "cameras, without further dimensions"
    )


def _intrinsics(viewmats: Tensor, matrices: Tensor) -> Tensor:
    """[C, 4] fx, fy, cx, cy."""
    if viewmats.ndim != 3 or tuple(matrices.shape) != (len(viewmats), 3, 3):
        raise InputError(
            f"viewmats has shape {list(viewmats.shape)} and Ks {list(matrices.shape)}; expected [C, 4, 4], [C, 3, 3]"
        )
    return torch.stack([matrices[:, row, column] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))], 1).detach()


def _project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    cameras: CameraBatch,
    *,
    sh_degree: int | None,
    near: float,
) -> Projected:
    """The projected Gaussians; per-camera coefficients are projected camera by camera."""
    log_scales = scales.abs().clamp(min=LEAST_SCALE).log()
    # For the bounds only: `_splats` passes on the opacities themselves.
    logits = opacities.detach().logit(eps=torch.finfo(opacities.dtype).eps)
    if sh_degree is None or colors.ndim == 3:
        sh = means.new_zeros(len(means), 0, 3) if sh_degree is None else colors
        gaussians = RawGaussians(means, quats, log_scales, logits, sh)
        return project(gaussians, cameras, sh_degree=sh_degree or 0, near=near)
    parts = [
        project(
            RawGaussians(means, quats, log_scales, logits, sh),
            cameras._replace(
                cam_from_world=cameras.cam_from_world[row : row + 1],
                intrinsics=cameras.intrinsics[row : row + 1],
                windows=None if cameras.windows is None else cameras.windows[row : row + 1],
            ),
            sh_degree=sh_degree,
            near=near,
        )
        for row, sh in enumerate(colors)
    ]
    return Projected(*(torch.cat(fields) for fields in zip(*parts, strict=True)))


def _splats(projected: Projected, opacities: Tensor, eps2d: float, *, antialiased: bool) -> Splats:
    """The splats with another added screen variance than that of 3DGS."""
    conics, shown, radii = projected.conics, opacities.expand(projected.depths.shape), projected.radii
    if antialiased or eps2d != LOW_PASS:
        a, b, c = _inverse(torch.where(radii[..., :1] > 0, conics, conics.new_tensor([1.0, 0.0, 1.0])))
        a, c = a - LOW_PASS, c - LOW_PASS
        wide = torch.stack([a + eps2d, b, c + eps2d], dim=-1)
        if antialiased:
            determinant = (a * c - b * b).clamp(min=0)
            # The root is not differentiable at zero, where a Gaussian is a line on screen.
            share = determinant / (wide[..., 0] * wide[..., 2] - b * b)
            shown = shown * torch.where(share > 0, share, 1).sqrt() * (share > 0)
        conics = torch.stack(_inverse(wide), dim=-1)
        reach = 2 * (shown / ALPHA_MIN).clamp(min=1).log()[..., None]
        radii = torch.where(radii > 0, (reach * wide[..., ::2].clamp(min=0)).sqrt().detach(), 0)
    return Splats(projected.means2d, conics.contiguous(), shown.contiguous(), projected.depths, radii)


def _inverse(symmetric: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Entries xx, xy, yy of the inverse of symmetric 2x2 matrices [..., 3]."""
    a, b, c = symmetric.unbind(-1)
    determinant = a * c - b * b
    return c / determinant, -b / determinant, a / determinant


def _blend(
    splats: Splats, channels: Tensor, bins: TileBins, *, chunk: int, with_absgrad: bool
) -> tuple[Tensor, Tensor]:
    """Images [C, H, W, D] and their coverage [C, H, W, 1]."""
    means2d = splats.means2d
    absgrad = torch.zeros_like(means2d, requires_grad=True) if with_absgrad and means2d.requires_grad else None
    if absgrad is not None:
        absgrad.register_hook(lambda gradient: setattr(means2d, "absgrad", gradient))
    parts = [composite(splats, part.contiguous(), bins, absgrad=absgrad) for part in channels.split(chunk, dim=-1)]
    return torch.cat([part.image for part in parts], dim=-1), parts[0].alpha[..., None]


def _finish(image: Tensor, alpha: Tensor, backgrounds: Tensor | None, render_mode: str) -> Tensor:
    """The image over its background, with the expected depth if requested."""
    colors, depth = (image, image[..., :0]) if render_mode == "RGB" else (image[..., :-1], image[..., -1:])
    if backgrounds is not None and render_mode.startswith("RGB"):
        if tuple(backgrounds.shape) != (len(image), colors.shape[-1]):
            raise InputError(
                f"backgrounds has shape {list(backgrounds.shape)}; expected [{len(image)}, {colors.shape[-1]}]"
            )
        colors = colors + (1 - alpha) * backgrounds[:, None, None]
    if render_mode.endswith("ED"):
        depth = depth / alpha.clamp(min=LEAST_ALPHA)
    return torch.cat([colors, depth], dim=-1)


def _meta(splats: Splats, width: int, height: int) -> dict[str, Any]:
    """The intermediate results with gsplat's names, not packed."""
    rows, columns = tile_grid(width, height)
    return {
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": splats.radii.detach().ceil().int(),
        "means2d": splats.means2d,
        "depths": splats.depths,
        "conics": splats.conics,
        "opacities": splats.opacities,
        "tile_height": rows,
        "tile_width": columns,
        "width": width,
        "height": height,
        "tile_size": TILE,
        "n_cameras": len(splats.depths),
    }
