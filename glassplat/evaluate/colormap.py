"""False colours for depth, errors, normals and labels."""

from __future__ import annotations

import torch
from torch import Tensor

# Lightness rises evenly from black through violet, red and amber to pale yellow, so that brighter always
# means more, in grey print too.
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
ERROR_SCALE = 0.2
"""The colour error that is drawn brightest; the same everywhere, so that pictures can be compared."""
COVERED = 0.5
"""Below this coverage a pixel has no depth worth showing."""


def heat_colors(values: Tensor) -> Tensor:
    """Colours [..., 3] in [0, 1] of values [...]; 0 is black, 1 pale yellow, what lies outside is clamped."""
    stops = torch.tensor(HEAT_STOPS, dtype=torch.float32, device=values.device) / 255
    position = values.to(torch.float32).nan_to_num(0.0).clamp(0, 1) * (len(HEAT_STOPS) - 1)
    lower = position.floor().clamp(max=len(HEAT_STOPS) - 2).long()
    share = (position - lower)[..., None]
    return stops[lower] * (1 - share) + stops[lower + 1] * share


def error_colors(image: Tensor, photo: Tensor) -> Tensor:
    """Colours [H, W, 3] in [0, 1] of how far an image [H, W, 3] is from a photograph [H, W, 3] of 0 to 255, by mean."""
    error = (image.clamp(0, 1) - photo.to(image) / 255).abs().mean(dim=-1)
    return heat_colors(error / ERROR_SCALE)


def depth_colors(depth: Tensor, alpha: Tensor | None = None) -> Tensor:
    """Colours [H, W, 3] in [0, 1] of a depth map [H, W]: near is bright, what is not covered is black.

    Colour is even in inverse depth between its 2nd and 98th percentile in this image.

    Args:
        depth: camera z, world units; 0 or less is no depth.
        alpha: [H, W] coverage; None takes every pixel with a depth.
    """
    shown = torch.isfinite(depth) & (depth > 0)
    if alpha is not None:
        shown &= alpha > COVERED
    if not bool(shown.any()):
        return torch.zeros(*depth.shape, 3, device=depth.device)
    inverse = torch.where(shown, 1 / torch.where(shown, depth, torch.ones_like(depth)), torch.zeros_like(depth))
    # Every n-th pixel is enough for percentiles, and `quantile` takes no more than 16 million.
    sample = inverse[shown]
    low, high = torch.quantile(
        sample[:: max(1, len(sample) // 100_000)].double(), sample.new_tensor([0.02, 0.98]).double()
    )
    span = (high - low).clamp(min=1e-12 + 1e-6 * high)
    # The dark end is kept for what has no depth.
    brightness = 0.08 + 0.92 * ((inverse - low) / span).clamp(0, 1)
    return heat_colors(brightness) * shown[..., None]


def normal_colors(normals: Tensor) -> Tensor:
    """Colours [..., 3] in [0, 1] of normals [..., 3]: (n + 1) / 2, so that what has none is grey."""
    return (0.5 * normals.nan_to_num(0.0) + 0.5).clamp(0, 1)


def label_colors(labels: Tensor) -> Tensor:
    """Colours [H, W, 3] in [0, 1] of pane labels [H, W]; 0 is black."""
    palette = torch.tensor(LABEL_COLORS, dtype=torch.float32, device=labels.device) / 255
    index = labels.long()
    return palette[(index - 1) % len(palette)] * (index > 0)[..., None]
