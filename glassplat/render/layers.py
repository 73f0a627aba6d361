"""Layers as images in false colours, sums over windows, and contributions of Gaussians to a view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from glassplat.kernels.composite import composite
from glassplat.kernels.records import Projected, ProjectedDiscs
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.frame import NEAR_PER_EXTENT, Frame, concat_splats, project_gaussians
from glassplat.render.panes import SeenPanes, nearest_hits, panes_in_camera, project_mirrored, seen_panes
from glassplat.render.planar import detach_gaussians
from glassplat.render.splat import blend_discs, blend_ellipsoids, projected_discs
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene

HEAT_STOPS = (
    (0, 0, 4),
    (31, 12, 72),
    (85, 15, 109),
    (136, 34, 106),
    (186, 54, 85),
    (227, 89, 51),
    (249, 140, 10),
    (249, 201, 50),
    (252, 255, 164),
)
"""Lightness rises evenly from black through violet, red and amber to pale yellow: brighter means more, also in grey."""
LABEL_COLORS = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (160, 160, 160),
)
"""Colours of panes, which colour-blind people can also tell apart (Okabe and Ito)."""
ERROR_SCALE = 0.2
"""Colour error drawn brightest; fixed, so that images can be compared."""
COVERED = 0.5
"""Minimum coverage for the display of depth."""


def heat_colors(values: Tensor) -> Tensor:
    """Colours [..., 3] in [0, 1] of values [...]: 0 is black, 1 pale yellow; values are clamped."""
    stops = torch.tensor(HEAT_STOPS, dtype=torch.float32, device=values.device) / 255
    position = values.to(torch.float32).nan_to_num(0.0).clamp(0, 1) * (len(HEAT_STOPS) - 1)
    lower = position.floor().clamp(max=len(HEAT_STOPS) - 2).long()
    share = (position - lower)[..., None]
    return stops[lower] * (1 - share) + stops[lower + 1] * share


def error_colors(image: Tensor, photo: Tensor) -> Tensor:
    """Colours [H, W, 3] in [0, 1] of the mean absolute error between an image [H, W, 3] and a photograph [H, W, 3], 0
    to 255.
    """
    error = (image.clamp(0, 1) - photo.to(image) / 255).abs().mean(dim=-1)
    return heat_colors(error / ERROR_SCALE)


def depth_colors(depth: Tensor, alpha: Tensor | None = None) -> Tensor:
    """Colours [H, W, 3] in [0, 1] of a depth map [H, W]: near is bright, empty is black.

    Colour is even in inverse depth between its 2nd and 98th percentile in this image.

    Args:
        depth: camera z, world units; 0 or less is no depth.
        alpha: [H, W] coverage; None uses every pixel with a depth.
    """
    shown = torch.isfinite(depth) & (depth > 0)
    if alpha is not None:
        shown &= alpha > COVERED
    if not bool(shown.any()):
        return torch.zeros(*depth.shape, 3, device=depth.device, dtype=torch.float32)
    inverse = torch.where(shown, 1 / torch.where(shown, depth, torch.ones_like(depth)), torch.zeros_like(depth))
    # Every n-th pixel suffices for percentiles, and `quantile` is limited to 16 million values.
    sample = inverse[shown]
    low, high = torch.quantile(
        sample[:: max(1, len(sample) // 100_000)].double(), sample.new_tensor([0.02, 0.98]).double()
    )
    span = (high - low).clamp(min=1e-12 + 1e-6 * high)
    # The dark end is reserved for pixels without depth.
    brightness = 0.08 + 0.92 * ((inverse - low) / span).clamp(0, 1)
    return heat_colors(brightness) * shown[..., None]


def normal_colors(normals: Tensor) -> Tensor:
    """Colours [..., 3] in [0, 1] of normals [..., 3]: (n + 1) / 2; zero is grey."""
    return (0.5 * normals.nan_to_num(0.0) + 0.5).clamp(0, 1)


def label_colors(labels: Tensor) -> Tensor:
    """Colours [H, W, 3] in [0, 1] of pane labels [H, W]; 0 is black."""
    palette = torch.tensor(LABEL_COLORS, dtype=torch.float32, device=labels.device) / 255
    index = labels.long()
    return palette[(index - 1) % len(palette)] * (index > 0)[..., None]


MEASURED: dict[str, Callable[[Tensor, Tensor | None], Tensor]] = {
    "normal": lambda normals, alpha: normal_colors(normals),
    "depth": depth_colors,
    "median_depth": depth_colors,
}
"""Layers whose values are not colours: their colours, by value and coverage. `glassplat render` also writes arrays."""


def layer_image(frame: Frame, layer: str) -> Tensor:
    """A layer as an image [H, W] or [H, W, 3] in [0, 1], by `MEASURED` where its values are not colours.

    Reflections are masked by their panes, because whole tiles are rendered.
    """
    if layer in ("rgb", "photographed"):
        image: Tensor = getattr(frame, layer)
        return image.clamp(0, 1)
    image = frame.layers[layer]
    if layer in MEASURED:
        return MEASURED[layer](image, frame.layers.get("alpha"))
    if layer == "reflection" and "mask" in frame.layers:
        image = image * frame.layers["mask"][..., None]
    return image.clamp(0, 1)


def contributions(scene: Scene, camera: Camera) -> Tensor:
    """[N] contribution of each primary Gaussian to a view, in pixels: the sum of its blending weights alpha_i T_i.

    It is the maximum over the direct image and those in panes; mirrored pixels count fully, however weak the
    reflection. After RadSplat (arXiv 2403.13806), which uses the largest weight instead of the sum: a Gaussian that
    covers a hundredth of a pixel is superfluous, however opaque.

    Args:
        scene: with or without panes.
        camera: camera of the view.
    """
    camera = camera.to(scene.primary.means.device)
    ones = scene.primary.means.new_ones(camera.height, camera.width, 1)
    most = gather_pixels(scene, camera, ones)[:, 0]
    if scene.primary.are_discs:
        return most
    seen = seen_panes(scene.planes, camera, nearest_hits(panes_in_camera(scene.planes, camera), camera))
    if seen is None:
        return most
    return torch.maximum(most, _gather_mirrored(scene, camera, ones, seen)[..., 0].amax(dim=0))


def gather_pixels(scene: Scene, camera: Camera, values: Tensor) -> Tensor:
    """[N, D] an image [H, W, D] summed over the pixels of each primary Gaussian, with its blending weights."""
    camera = camera.to(scene.primary.means.device)
    primary, near = _without_harmonics(scene), NEAR_PER_EXTENT * scene.extent
    if primary.are_discs:
        discs = projected_discs(primary, camera, near=near)
        return _gather(discs, values, lambda ones: blend_discs(discs, ones, camera, near=near).image)[0]
    projected = project_gaussians(primary, camera, near=near)
    return _gather(projected, values, lambda ones: blend_ellipsoids(projected, ones, camera).image)[0]


def gather_mirrored_pixels(scene: Scene, camera: Camera, values: Tensor) -> Tensor:
    """[N, D] the same, with the weights in the reflection of each pixel's nearest pane."""
    camera = camera.to(scene.primary.means.device)
    seen = seen_panes(scene.planes, camera, nearest_hits(panes_in_camera(scene.planes, camera), camera), most=1)
    if seen is None:
        return values.new_zeros(len(scene.primary), values.shape[-1])
    of_pane = seen.order[0] == torch.arange(len(seen.planes), device=values.device)[:, None, None]
    return _gather_mirrored(scene, camera, of_pane[..., None] * values, seen).sum(dim=0)


def _without_harmonics(scene: Scene) -> Gaussians:
    """The primary Gaussians for projection without gradients, where colours are not needed."""
    return replace(detach_gaussians(scene.primary), active_sh_degree=0)


def _gather_mirrored(scene: Scene, camera: Camera, values: Tensor, seen: SeenPanes) -> Tensor:
    """[K, N, D] as `_gather`, of the primary Gaussians in the images mirrored by K panes."""
    projected = project_mirrored(_without_harmonics(scene), camera, seen, near=NEAR_PER_EXTENT * scene.extent)
    splats = concat_splats(projected)
    bins = bin_tiles(splats, camera.width, camera.height, seen.tiles)
    return _gather(projected, values, lambda ones: composite(splats, ones, bins).image)


def _gather(projected: Projected | ProjectedDiscs, values: Tensor, blend: Callable[[Tensor], Tensor]) -> Tensor:
    """[C, N, D] gradient of a constant channel if `values` are the gradients of the images.

    They are [C, H, W, D], or [H, W, D] for all images.
    """
    with torch.enable_grad():
        ones = projected.depths.new_ones(*projected.depths.shape, values.shape[-1]).requires_grad_()
        (sums,) = torch.autograd.grad((blend(ones) * values).sum(), ones)
    return sums


def window_means(image: Tensor, region: Tensor, radius: int) -> Tensor:
    """[H, W, D] float64 means over the part of each window (see `window_sums`) inside a region [H, W].

    Values outside the region may be NaN.
    """
    inside = region.to(image.dtype)[..., None]
    sums = window_sums(torch.cat([torch.where(inside > 0, image, 0), inside], dim=-1), radius)
    return sums[..., :-1] / sums[..., -1:].clamp(min=1)


def window_sums(image: Tensor, radius: int) -> Tensor:
    """[H, W, D] float64 sums over the square of pixels up to `radius` away, cut off at the image's border.

    Differences of running sums along each axis, so that the cost does not depend on the window. A NaN therefore reaches
    all sums below and to the right of it.
    """
    sums = image.double()
    for axis in (0, 1):
        running = torch.cat([torch.zeros_like(sums.narrow(axis, 0, 1)), sums.cumsum(axis)], dim=axis)
        positions = torch.arange(image.shape[axis], device=image.device)
        after, before = (positions + radius + 1).clamp(max=len(positions)), (positions - radius).clamp(min=0)
        sums = running.index_select(axis, after) - running.index_select(axis, before)
    return sums
