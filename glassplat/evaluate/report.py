"""The overview page of an evaluation."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from glassplat.captures.dataset import Dataset
from glassplat.evaluate import metrics
from glassplat.evaluate.evaluate import EvaluatedView
from glassplat.evaluate.truth import UNKNOWN_SURFACE, TrueSurface, TrueView
from glassplat.files.images import flat_image_names, write_image
from glassplat.files.writing import write_text
from glassplat.options import Blend
from glassplat.render.frame import Frame
from glassplat.render.layers import ERROR_SCALE, depth_colors, error_colors, label_colors, layer_image, normal_colors
from glassplat.render.planar import as_mirror_image, dereflected_photo

STYLE = """
:root { color-scheme: dark }
body { margin: 0 auto; max-width: 1700px; padding: 24px; background: #16181c; color: #ececec;
       font: 15px/1.5 system-ui, sans-serif }
h1 { margin: 0; font-size: 24px; font-weight: 600 }
a { color: inherit }
.settings { margin: 4px 0 20px; color: #a0a6ae }
.settings b { color: #ececec; font-weight: 500 }
.settings p { margin: 0 }
.cards { display: flex; flex-wrap: wrap; gap: 10px; margin-bottom: 20px }
.cards div { min-width: 118px; padding: 10px 14px; border-radius: 8px; background: #22252b }
.cards b { display: block; font-size: 19px; font-weight: 600; font-variant-numeric: tabular-nums }
.cards span { color: #a0a6ae; font-size: 13px }
.scroll { overflow-x: auto; margin-bottom: 20px }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th { color: #a0a6ae; font-weight: 400 }
th, td { padding: 3px 18px 3px 0; text-align: right; border-bottom: 1px solid #2b2f36 }
th:first-child, td:first-child { text-align: left }
figure { margin: 0 0 20px; scroll-margin-top: 12px }
figure img { display: block; width: 100%; height: auto; border-radius: 8px; border: 1px solid #2b2f36;
             box-sizing: border-box; cursor: zoom-in }
.meanings { color: #a0a6ae; font-size: 13px }
.meanings h2 { margin: 24px 0 8px; font-size: 15px; font-weight: 600; color: #ececec }
.meanings dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; margin: 0 0 8px }
.meanings dt { color: #ececec }
.meanings dd { margin: 0 }
dialog { max-width: none; max-height: none; width: 100vw; height: 100vh; padding: 0; border: 0; overflow: auto;
         background: #0c0d0f; cursor: zoom-out; box-sizing: border-box }
dialog img { display: block; margin: auto; min-width: 100% }
"""

# Without scripts the links open the image itself.
SCRIPT = """
const large = document.getElementById("large");
for (const link of document.querySelectorAll("figure a"))
  link.addEventListener("click", event => {
    event.preventDefault();
    large.firstElementChild.src = link.href;
    large.showModal();
  });
large.addEventListener("click", () => large.close());
"""


NARROWEST_PANEL, WIDEST_PANEL = 280, 640
"""Widths of an image on a sheet below and above which it is scaled, pixels."""
MARGIN, GAP, CAPTION_SIZE, CAPTION_MARGIN, TITLE_SIZE = 16, 10, 15, 9, 19
"""Space around and between images, heights of the letters of captions and title, and space above captions, pixels."""
CAPTION_HEIGHT, TITLE_HEIGHT = CAPTION_SIZE + CAPTION_MARGIN, 34
BACKGROUND, TEXT, MUTED_TEXT = (22, 24, 28), (236, 236, 236), (160, 166, 174)
"""Colours of a sheet, 0 to 255."""
SMALLEST_STRENGTH_SCALE = 0.05
"""Minimum strength that is drawn white."""
COLORED = ("transmission", "base", "reflection", "environment")
COLUMNS = (*COLORED, "strength", "normal", "mask")
"""Layers in the order in which they are shown."""


@dataclass(frozen=True)
class Panel:
    """One image [H, W, 3] in [0, 1] or uint8, and its caption."""

    caption: str
    image: Tensor


Row = Sequence[Panel | None]
"""Panels side by side; None leaves a gap."""


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

    First row: photograph, render, error, depth. Second row, if the method renders them: transmission, base, reflection,
    environment, strength, normals, mask. Third row, if they are known: the true ones, in the same columns.

    Args:
        frame: as rendered, on the CPU.
        photo: [H, W, 3] uint8.
        truth: the true layers.
        surface: the true surface.
        title: set in large type; usually the view's name.
        subtitle: set in small type next to it; usually the metrics.
    """
    rows: list[Row] = [_image_row(frame, photo), *_layer_rows(frame, truth, surface or UNKNOWN_SURFACE)]
    return compose_sheet([row for row in rows if any(row)], title, subtitle)


def compose_sheet(
    rows: Sequence[Row], title: str, subtitle: str, *, caption_size: int = CAPTION_SIZE
) -> NDArray[np.uint8]:
    """Panels in rows, with captions and a title line; all panels of a row have the size of its first one."""
    caption_height = caption_size + CAPTION_MARGIN
    sizes = [_panel_size(*next(panel for panel in row if panel).image.shape[1::-1]) for row in rows]
    width = max(len(row) * (size[0] + GAP) - GAP for row, size in zip(rows, sizes, strict=True))
    height = sum(caption_height + size[1] + GAP for size in sizes) - GAP
    canvas = Image.new("RGB", (2 * MARGIN + width, 2 * MARGIN + TITLE_HEIGHT + height), BACKGROUND)
    _draw_title(ImageDraw.Draw(canvas), title, subtitle, canvas.width)
    y = MARGIN + TITLE_HEIGHT
    for row, size in zip(rows, sizes, strict=True):
        for column, panel in enumerate(row):
            if panel is not None:
                _draw_panel(canvas, panel, (MARGIN + column * (size[0] + GAP), y), size, caption_size)
        y += caption_height + size[1] + GAP
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
    panels = {name: Panel(name.replace("_", " "), layer_image(frame, name)) for name in COLORED if name in layers}
    if "strength" in layers:
        panels["strength"] = _strength_panel("strength", layers["strength"], scale)
    if "normal" in layers:
        panels["normal"] = Panel("normals", normal_colors(layers["normal"]))
    if "mask" in layers:
        panels["mask"] = Panel("mask", _grey(layers["mask"]))
    return panels


def _true_panels(truth: TrueView | None, surface: TrueSurface, scale: float) -> dict[str, Panel]:
    """Panels of the ground truth, by the name of the corresponding layer."""
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
    # Glass reaches 1 at grazing angles, but the bulk of the pane should be visible.
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


def _draw_panel(
    canvas: Image.Image, panel: Panel, corner: tuple[int, int], size: tuple[int, int], caption_size: int
) -> None:
    image = Image.fromarray(metrics.quantize(panel.image).contiguous().numpy())
    if image.size != size:
        grows = size[0] > image.width
        image = image.resize(size, Image.Resampling.NEAREST if grows else Image.Resampling.LANCZOS)
    canvas.paste(image, (corner[0], corner[1] + caption_size + CAPTION_MARGIN))
    font = ImageFont.load_default(caption_size)
    ImageDraw.Draw(canvas).text((corner[0], corner[1] + 2), _one_line(panel.caption), fill=MUTED_TEXT, font=font)


def _draw_title(draw: ImageDraw.ImageDraw, title: str, subtitle: str, width: int) -> None:
    title_font, font = ImageFont.load_default(TITLE_SIZE), ImageFont.load_default(CAPTION_SIZE)
    title, baseline = _one_line(title), MARGIN + TITLE_SIZE
    draw.text((MARGIN, baseline), title, fill=TEXT, font=title_font, anchor="ls")
    start = MARGIN + draw.textlength(title, font=title_font) + 2 * GAP
    # A narrow sheet has no room for the metrics; the overview page lists them anyway.
    if start + draw.textlength(subtitle, font=font) <= width - MARGIN:
        draw.text((start, baseline), subtitle, fill=MUTED_TEXT, font=font, anchor="ls")


def _one_line(text: str) -> str:
    """A text without the line breaks that a photograph's name may have."""
    return " ".join(text.splitlines())


MOST_VIEWS, SMALLEST_SHARE = 2, 0.05
"""Maximum number of views, and minimum share of the image that must show a pane for a view to be included."""


USES_FILE = "uses.png"
SETTINGS = ("iterations", "seed", "resolution", "split", "lpips_backbone", "pane_region")


class Report:
    """The images of an evaluation, drawn while it runs: each view's frame is used once and released.

    Writes `sheets/<view>.png` for every test view, `uses.png` for a method that separates the reflection, and
    `index.html`, which shows them all. Nothing outside the folder is referenced, so it can be moved or sent.
    """

    def __init__(self, folder: Path, dataset: Dataset, blend: Blend | None) -> None:
        """Prepares for the test views of a data set.

        Args:
            folder: a run's directory.
            dataset: with the test views that will be added.
            blend: the colour space in which the run blends the reflection; None for a method without reflection.
        """
        self._folder = folder
        self._sheets = sheet_names([view.name for view in dataset.test])
        self._blend = blend
        self._uses: list[tuple[float, list[Panel]]] = []

    def add(self, evaluated: EvaluatedView) -> None:
        """Draws one view; called by `evaluate`."""
        view, subtitle = evaluated.view, _metrics_line(evaluated.metrics)
        sheet = comparison_sheet(
            evaluated.photographed,
            view.photo,
            evaluated.truth,
            surface=evaluated.surface,
            title=view.name,
            subtitle=subtitle,
        )
        write_image(self._folder / self._sheets[view.name], sheet)
        if self._blend is not None:
            self._add_uses(evaluated, self._blend)

    def _add_uses(self, evaluated: EvaluatedView, blend: Blend) -> None:
        """Keeps what the layers of a view are good for, if it shows more of a pane than the views kept so far."""
        frame, photo = evaluated.frame, evaluated.view.photo
        share = float((frame.layers["strength"] > 0).float().mean())
        if share < SMALLEST_SHARE:
            return
        plain = dereflected_photo(frame, photo, blend, exposures=evaluated.exposures, name=evaluated.view.name)
        row = [
            Panel(f"photograph {evaluated.view.name}", photo),
            Panel("without reflections (glassplat dereflect)", plain),
            Panel("pane as a mirror (glassplat render)", metrics.quantize(as_mirror_image(frame, blend))),
        ]
        self._uses = sorted([*self._uses, (share, row)], key=lambda kept: -kept[0])[:MOST_VIEWS]

    def finish(self, results: Mapping[str, Any], per_view: Mapping[str, Mapping[str, Any]]) -> None:
        """Writes the overview.

        Args:
            results: as `evaluate` returns them, with additions of the caller.
            per_view: as `evaluate` returns it.
        """
        if self._uses:
            write_image(
                self._folder / USES_FILE, compose_sheet([row for _, row in self._uses], "Uses of the layers", "")
            )
        page = overview_page(results, per_view, self._sheets, uses=USES_FILE if self._uses else None)
        write_text(self._folder / "index.html", page)


def sheet_names(names: list[str]) -> dict[str, str]:
    """File of each view's sheet, relative to the run; distinct even for `a.jpg` and `a.png`."""
    return {name: f"sheets/{file}" for name, file in flat_image_names(names).items()}


def overview_page(
    results: Mapping[str, Any],
    per_view: Mapping[str, Mapping[str, Any]],
    sheets: Mapping[str, str],
    *,
    uses: str | None = None,
) -> str:
    """The overview as one HTML page; its only references are the images, by relative path."""
    title = f"glassplat: {results.get('method', 'evaluation')}"
    known = {name.replace("_", " "): results[name] for name in SETTINGS if results.get(name) is not None}
    settings = " · ".join(f"{_escape(name)} <b>{_escape(value)}</b>" for name, value in known.items())
    parts = [
        f"<h1>{_escape(title)}</h1>",
        f'<p class="settings">{settings}</p>',
        _cards(results),
        _missing_metrics(results),
        _figure("uses", uses, "photographs without reflections, and panes as mirrors") if uses else "",
        _plane_table(results.get("planes") or []),
        _view_table(per_view, sheets),
        *(_figure(name, path, f"comparison sheet of {name}") for name, path in sheets.items()),
        _meanings(results),
        '<dialog id="large"><img alt=""></dialog>',
    ]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{_escape(title)}</title>'
    body = "\n".join(part for part in parts if part)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>{head}<style>{STYLE}</style></head>\n'
        f"<body>\n{body}\n<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def _cards(results: Mapping[str, Any]) -> str:
    cards = []
    for name, metric in metrics.shown_metrics(results).items():
        explanation = metric.meaning if results[name] is not None else results.get(f"{name}_reason") or ""
        value = _format(results[name], metric.pattern)
        cards.append(f'<div title="{_escape(explanation)}"><b>{value}</b><span>{metric.label}</span></div>')
    return f'<div class="cards">{"".join(cards)}</div>'


def _missing_metrics(results: Mapping[str, Any]) -> str:
    """Reasons for missing metrics, and the number of views of means over some of them."""
    known = metrics.shown_metrics(results)
    lines = [
        f"<p>Not measured: <b>{_escape('; '.join(known[name].label for name in names))}</b>: {_escape(reason)}</p>"
        for reason, names in metrics.missing_reasons(results).items()
    ]
    lines += [
        f"<p>Means over {count} of {results['num_test_views']} views: "
        f"<b>{_escape('; '.join(known[name].label for name in names))}</b></p>"
        for count, names in metrics.partial_means(results).items()
    ]
    return f'<div class="settings">{"".join(lines)}</div>' if lines else ""


def _meanings(results: Mapping[str, Any]) -> str:
    """Meanings of the numbers, at the end of the page."""
    planes = metrics.PLANE_COLUMNS if results.get("planes") else {}
    parts = [f"<dl>{_definition_list(metrics.shown_metrics(results))}</dl>"]
    if planes:
        parts.append(f"<p>Of each pane:</p><dl>{_definition_list(planes)}</dl>")
    return f'<section class="meanings"><h2>What the numbers mean</h2>{"".join(parts)}</section>'


def _definition_list(known: Mapping[str, metrics.Metric]) -> str:
    return "".join(f"<dt>{_escape(m.label)}</dt><dd>{_escape(m.meaning)}</dd>" for m in known.values())


def _plane_table(planes: list[Mapping[str, Any]]) -> str:
    if not planes:
        return ""
    columns = _with_values(metrics.PLANE_COLUMNS, planes)
    rows = [[_format(plane.get(name), column.pattern) for name, column in columns.items()] for plane in planes]
    return _table([column.label for column in columns.values()], rows)


def _view_table(per_view: Mapping[str, Mapping[str, Any]], sheets: Mapping[str, str]) -> str:
    shown = _with_values(metrics.METRICS | metrics.SURFACE_METRICS, list(per_view.values()))
    rows = [
        [_link(name, sheets), *(_format(row.get(metric), column.pattern) for metric, column in shown.items())]
        for name, row in per_view.items()
    ]
    return _table(["view", *(column.label for column in shown.values())], rows)


def _with_values(columns: Mapping[str, metrics.Metric], rows: Sequence[Mapping[str, Any]]) -> dict[str, metrics.Metric]:
    """The columns in which a row has a value."""
    return {n: column for n, column in columns.items() if any(row.get(n) is not None for row in rows)}


def _table(head: list[str], rows: list[list[str]]) -> str:
    cells = "".join(f"<th>{label}</th>" for label in head)
    lines = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>\n" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>\n{lines}</tbody></table></div>'


def _link(name: str, sheets: Mapping[str, str]) -> str:
    return f'<a href="#{_escape(name)}">{_escape(name)}</a>' if name in sheets else _escape(name)


def _figure(name: str, path: str, description: str) -> str:
    address = _escape(quote(path))
    return (
        f'<figure id="{_escape(name)}"><a href="{address}">'
        f'<img src="{address}" alt="{_escape(description)}" loading="lazy"></a></figure>'
    )


def _metrics_line(values: Mapping[str, Any]) -> str:
    known = _with_values(metrics.METRICS | metrics.SURFACE_METRICS, [values])
    return "    ".join(f"{metric.label} {_format(values[n], metric.pattern)}" for n, metric in known.items())


def _format(value: object, pattern: str) -> str:
    return _escape(metrics.format_value(value, pattern))


def _escape(value: object) -> str:
    return html.escape(str(value), quote=True)
