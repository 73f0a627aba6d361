"""Comparison sheets: everything that the renderer made of a test view, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from glassplat.evaluate.evaluate import EvaluatedView
from glassplat.evaluate.metrics import quantized
from glassplat.evaluate.truth import NOTHING_KNOWN, TrueSurface, TrueView
from glassplat.options import Blend
from glassplat.render.frame import Frame
from glassplat.render.layers import ERROR_SCALE, depth_colors, error_colors, label_colors, normal_colors
from glassplat.render.planar import as_mirror_image, dereflected_photo

NARROWEST_PANEL, WIDEST_PANEL = 280, 640
MARGIN, GAP = 16, 10
CAPTION_HEIGHT, TITLE_HEIGHT = 24, 34
CAPTION_SIZE, TITLE_SIZE = 15, 19
BACKGROUND, TEXT, QUIET_TEXT = (22, 24, 28), (236, 236, 236), (160, 166, 174)
SMALLEST_STRENGTH_SCALE = 0.05
COLORED = ("transmission", "base", "reflection", "environment")
COLUMNS = (*COLORED, "strength", "normal", "mask")
"""Layers in the order in which they are shown."""


@dataclass(frozen=True)
class Panel:
    """One picture [H, W, 3] in [0, 1] or uint8, and what is written above it."""

    caption: str
    image: Tensor


Row = Sequence[Panel | None]
"""Panels side by side; None leaves the place empty."""


def comparison_sheet(
    frame: Frame,
    photo: Tensor,
    truth: TrueView | None,
    *,
    surface: TrueSurface | None = None,
    title: str,
    subtitle: str = "",
) -> NDArray[np.uint8]:
    """The sheet [H, W, 3] of one view.

    First row: photograph, render, error, depth. Second row, where the method has them: transmission, base,
    reflection, environment, strength, normals, mask. Third row, where they are known: the true ones, in the same
    columns.

    Args:
        frame: what was rendered, on the CPU.
        photo: [H, W, 3] uint8.
        truth: the true layers.
        surface: the true surface.
        title: set in large type; usually the view's name.
        subtitle: set in small type beside it; usually the metrics.
    """
    rows: list[Row] = [_image_row(frame, photo), *_layer_rows(frame, truth, surface or NOTHING_KNOWN)]
    return composed([row for row in rows if any(row)], title, subtitle)


def composed(rows: Sequence[Row], title: str, subtitle: str) -> NDArray[np.uint8]:
    """Panels of one size in rows, with captions and a title line."""
    height, width = next(panel for row in rows for panel in row if panel).image.shape[:2]
    panel_size = _panel_size(width, height)
    columns = max(len(row) for row in rows)
    row_height = CAPTION_HEIGHT + panel_size[1] + GAP
    size = (
        2 * MARGIN + columns * panel_size[0] + (columns - 1) * GAP,
        2 * MARGIN + TITLE_HEIGHT + len(rows) * row_height - GAP,
    )
    canvas = Image.new("RGB", size, BACKGROUND)
    _draw_title(ImageDraw.Draw(canvas), title, subtitle, size[0])
    for row_index, row in enumerate(rows):
        for column, panel in enumerate(row):
            if panel is None:
                continue
            x = MARGIN + column * (panel_size[0] + GAP)
            y = MARGIN + TITLE_HEIGHT + row_index * row_height
            _draw_panel(canvas, panel, (x, y), panel_size)
    return np.array(canvas)


def _image_row(frame: Frame, photo: Tensor) -> list[Panel]:
    row = [
        Panel("photograph", photo),
        Panel("render", frame.photographed),
        Panel(f"error (brightest: {ERROR_SCALE:g} and more)", error_colors(frame.photographed, photo)),
    ]
    if "photographed" in frame.layers:
        row.append(Panel("the scene itself", frame.rgb))
    if "depth" in frame.layers:
        row.append(Panel("depth (near is bright)", depth_colors(frame.layers["depth"], frame.layers.get("alpha"))))
    return row


def _layer_rows(frame: Frame, truth: TrueView | None, surface: TrueSurface) -> tuple[Row, Row]:
    """Rendered layers, with the true ones below."""
    maps = [frame.layers.get("strength"), surface.strength, None if truth is None else truth.strength]
    scale = _strength_scale([strength for strength in maps if strength is not None])
    rendered, true = _rendered_panels(frame, scale), _true_panels(truth, surface, scale)
    columns = [name for name in COLUMNS if name in rendered or name in true]
    return [rendered.get(name) for name in columns], [true.get(name) for name in columns]


def _rendered_panels(frame: Frame, scale: float) -> dict[str, Panel]:
    """Panels of a frame's layers by name."""
    layers = frame.layers
    panels = {name: Panel(name.replace("_", " "), layers[name]) for name in COLORED if name in layers}
    if "strength" in layers:
        panels["strength"] = _strength_panel("strength", layers["strength"], scale)
    if "normal" in layers:
        panels["normal"] = Panel("normals", normal_colors(layers["normal"]))
    if "mask" in layers:
        panels["mask"] = Panel("mask", _grey(layers["mask"]))
    return panels


def _true_panels(truth: TrueView | None, surface: TrueSurface, scale: float) -> dict[str, Panel]:
    """Panels of what is known to be true, by the name of the layer that should be like it."""
    panels = {}
    if surface.strength is not None:
        panels["strength"] = _strength_panel("true strength", surface.strength, scale)
    if surface.normals is not None:
        panels["normal"] = Panel("true normals", normal_colors(surface.normals))
    if truth is not None:
        panels["transmission"] = Panel("true transmission", truth.transmission)
        panels["reflection"] = Panel("true reflection", truth.reflection)
        panels["strength"] = _strength_panel("true strength", truth.strength, scale)
        panels["mask"] = Panel("true panes", label_colors(truth.labels))
    return panels


def _strength_panel(caption: str, strength: Tensor, scale: float) -> Panel:
    return Panel(f"{caption} (white: {scale:.2f})", _grey(strength / scale))


def _strength_scale(maps: Sequence[Tensor]) -> float:
    """One scale for rendered and true strength, so that the two can be compared by eye."""
    # Glass at grazing angles reaches 1; the bulk of the pane is what should be seen.
    peaks = [float(np.percentile(strength.numpy(), 98)) for strength in maps]
    return min(max([*peaks, SMALLEST_STRENGTH_SCALE]), 1.0)


def _grey(values: Tensor) -> Tensor:
    return values.clamp(0, 1)[..., None].expand(*values.shape, 3)


def _panel_size(width: int, height: int) -> tuple[int, int]:
    """Small images grow by a whole factor, so that captions fit; large ones shrink."""
    if width < NARROWEST_PANEL:
        factor: float = -(-NARROWEST_PANEL // width)
    else:
        factor = min(1.0, WIDEST_PANEL / width)
    return round(width * factor), round(height * factor)


def _draw_panel(canvas: Image.Image, panel: Panel, corner: tuple[int, int], size: tuple[int, int]) -> None:
    picture = Image.fromarray(quantized(panel.image).contiguous().numpy())
    if picture.size != size:
        grows = size[0] > picture.width
        picture = picture.resize(size, Image.Resampling.NEAREST if grows else Image.Resampling.LANCZOS)
    canvas.paste(picture, (corner[0], corner[1] + CAPTION_HEIGHT))
    font = ImageFont.load_default(CAPTION_SIZE)
    ImageDraw.Draw(canvas).text((corner[0], corner[1] + 2), panel.caption, fill=QUIET_TEXT, font=font)


def _draw_title(draw: ImageDraw.ImageDraw, title: str, subtitle: str, width: int) -> None:
    title_font, font = ImageFont.load_default(TITLE_SIZE), ImageFont.load_default(CAPTION_SIZE)
    baseline = MARGIN + TITLE_SIZE
    draw.text((MARGIN, baseline), title, fill=TEXT, font=title_font, anchor="ls")
    start = MARGIN + draw.textlength(title, font=title_font) + 2 * GAP
    # A narrow sheet has no room for the metrics; the overview page lists them anyway.
    if start + draw.textlength(subtitle, font=font) <= width - MARGIN:
        draw.text((start, baseline), subtitle, fill=QUIET_TEXT, font=font, anchor="ls")


MOST_VIEWS = 2
SMALLEST_SHARE = 0.05
"""Part of the image that must be pane for a view to be worth showing."""


class Uses:
    """Keeps the views that show most of a pane, out of all that pass by, and draws them."""

    def __init__(self, blend: Blend) -> None:
        """Begins with no view; `blend` is the space in which the run blends the reflection."""
        self._blend = blend
        self._rows: list[tuple[float, list[Panel]]] = []

    def add(self, evaluated: EvaluatedView) -> None:
        """Looks at a view, and keeps its panels if it shows more of a pane than those kept."""
        frame, photo = evaluated.frame, evaluated.view.photo
        share = float((frame.layers["strength"] > 0).float().mean())
        if share < SMALLEST_SHARE:
            return
        plain = dereflected_photo(frame, photo, self._blend, exposures=evaluated.exposures, name=evaluated.view.name)
        row = [
            Panel(f"photograph {evaluated.view.name}", photo),
            Panel("without reflections (glassplat dereflect)", plain),
            Panel("pane as a mirror (glassplat render --as-mirror)", quantized(as_mirror_image(frame, self._blend))),
        ]
        self._rows = sorted([*self._rows, (share, row)], key=lambda kept: -kept[0])[:MOST_VIEWS]

    def picture(self) -> NDArray[np.uint8] | None:
        """The views kept [H, W, 3], one per row; None where no view shows a pane."""
        return composed([row for _, row in self._rows], "What the layers are good for", "") if self._rows else None
