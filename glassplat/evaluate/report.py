"""The overview page of an evaluation."""

from __future__ import annotations

import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from glassplat.captures.dataset import Dataset
from glassplat.evaluate.evaluate import EvaluatedView
from glassplat.evaluate.metric_names import (
    METRICS,
    PLANE_COLUMNS,
    SURFACE_METRICS,
    Metric,
    missing_reasons,
    shown_metrics,
    written,
)
from glassplat.evaluate.overview_style import SCRIPT, STYLE
from glassplat.evaluate.sheet import Uses, comparison_sheet
from glassplat.files.images import flat_picture_names, write_image
from glassplat.files.writing import atomic_write
from glassplat.options import Blend

USES_FILE = "uses.png"
SETTINGS = ("iterations", "seed", "resolution", "split", "lpips_backbone", "pane_region")


class Report:
    """The pictures of an evaluation, drawn while it runs: each view's frame is used once and let go.

    Writes `sheets/<view>.png` for every test view, `uses.png` for a method that separates the reflection, and
    `index.html` that shows them all. Nothing outside the folder is referred to, so it can be moved or sent.
    """

    def __init__(self, folder: Path, dataset: Dataset, blend: Blend | None) -> None:
        """Prepares for the test views of a data set.

        Args:
            folder: a run's directory.
            dataset: the test views that will come.
            blend: the space in which the run blends the reflection; None for a method without reflection.
        """
        self._folder = folder
        self._sheets = sheet_names([view.name for view in dataset.test])
        self._uses = Uses(blend) if blend is not None else None

    def add(self, evaluated: EvaluatedView) -> None:
        """Draws one view; for `evaluate` to call."""
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
        if self._uses is not None:
            self._uses.add(evaluated)

    def finish(self, results: Mapping[str, Any], per_view: Mapping[str, Mapping[str, Any]]) -> None:
        """Writes the overview.

        Args:
            results: as `evaluate` returns them, with what the caller added.
            per_view: as `evaluate` returns it.
        """
        uses = self._uses.picture() if self._uses is not None else None
        if uses is not None:
            write_image(self._folder / USES_FILE, uses)
        page = overview_page(results, per_view, self._sheets, uses=None if uses is None else USES_FILE)
        with atomic_write(self._folder / "index.html") as temporary:
            temporary.write_text(page, encoding="utf-8")


def sheet_names(names: list[str]) -> dict[str, str]:
    """File of each view's sheet, relative to the run; distinct also for `a.jpg` and `a.png`."""
    return {name: f"sheets/{file}" for name, file in flat_picture_names(names).items()}


def overview_page(
    results: Mapping[str, Any],
    per_view: Mapping[str, Mapping[str, Any]],
    sheets: Mapping[str, str],
    *,
    uses: str | None = None,
) -> str:
    """The overview as one HTML page; its only references are the pictures, by relative path."""
    title = f"glassplat: {results.get('method', 'evaluation')}"
    parts = [
        f"<h1>{_escaped(title)}</h1>",
        f'<p class="settings">{_settings_line(results)}</p>',
        _cards(results),
        _missing(results),
        _figure("uses", uses, "photographs without reflections, and panes as mirrors") if uses else "",
        _plane_table(results.get("planes") or []),
        _view_table(per_view, sheets),
        *(_figure(name, path, f"comparison sheet of {name}") for name, path in sheets.items()),
        _meanings(results),
        '<dialog id="large"><img alt=""></dialog>',
    ]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{_escaped(title)}</title>'
    body = "\n".join(part for part in parts if part)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>{head}<style>{STYLE}</style></head>\n'
        f"<body>\n{body}\n<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def _settings_line(results: Mapping[str, Any]) -> str:
    known = [(name.replace("_", " "), results[name]) for name in SETTINGS if results.get(name) is not None]
    return " · ".join(f"{_escaped(name)} <b>{_escaped(value)}</b>" for name, value in known)


def _cards(results: Mapping[str, Any]) -> str:
    cards = []
    for name, metric in shown_metrics(results).items():
        told = metric.meaning if results[name] is not None else results.get(f"{name}_reason") or ""
        value = _formatted(results[name], metric.pattern)
        cards.append(f'<div title="{_escaped(told)}"><b>{value}</b><span>{metric.label}</span></div>')
    return f'<div class="cards">{"".join(cards)}</div>'


def _missing(results: Mapping[str, Any]) -> str:
    """Reasons for the dashes among the metrics."""
    metrics = shown_metrics(results)
    lines = [
        f"<p>Not measured: <b>{_escaped('; '.join(metrics[name].label for name in names))}</b>: {_escaped(reason)}</p>"
        for reason, names in missing_reasons(results).items()
    ]
    return f'<div class="settings">{"".join(lines)}</div>' if lines else ""


def _meanings(results: Mapping[str, Any]) -> str:
    """Meanings of the numbers, at the end of the page."""
    planes = PLANE_COLUMNS if results.get("planes") else {}
    parts = [f"<dl>{_defined(shown_metrics(results))}</dl>"]
    if planes:
        parts.append(f"<p>Of each pane:</p><dl>{_defined(planes)}</dl>")
    return f'<section class="meanings"><h2>What the numbers mean</h2>{"".join(parts)}</section>'


def _defined(metrics: Mapping[str, Metric]) -> str:
    return "".join(f"<dt>{_escaped(m.label)}</dt><dd>{_escaped(m.meaning)}</dd>" for m in metrics.values())


def _plane_table(planes: list[Mapping[str, Any]]) -> str:
    if not planes:
        return ""
    columns = {n: column for n, column in PLANE_COLUMNS.items() if any(plane.get(n) is not None for plane in planes)}
    rows = [[_formatted(plane.get(name), column.pattern) for name, column in columns.items()] for plane in planes]
    return _table([column.label for column in columns.values()], rows)


def _view_table(per_view: Mapping[str, Mapping[str, Any]], sheets: Mapping[str, str]) -> str:
    columns = METRICS | SURFACE_METRICS
    shown = {n: column for n, column in columns.items() if any(row.get(n) is not None for row in per_view.values())}
    rows = [
        [_link(name, sheets), *(_formatted(row.get(metric), column.pattern) for metric, column in shown.items())]
        for name, row in per_view.items()
    ]
    return _table(["view", *(column.label for column in shown.values())], rows)


def _table(head: list[str], rows: list[list[str]]) -> str:
    cells = "".join(f"<th>{label}</th>" for label in head)
    lines = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>\n" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>\n{lines}</tbody></table></div>'


def _link(name: str, sheets: Mapping[str, str]) -> str:
    return f'<a href="#{_escaped(name)}">{_escaped(name)}</a>' if name in sheets else _escaped(name)


def _figure(name: str, path: str, description: str) -> str:
    return (
        f'<figure id="{_escaped(name)}"><a href="{_escaped(path)}">'
        f'<img src="{_escaped(path)}" alt="{_escaped(description)}" loading="lazy"></a></figure>'
    )


def _metrics_line(metrics: Mapping[str, Any]) -> str:
    known = {n: metric for n, metric in (METRICS | SURFACE_METRICS).items() if metrics.get(n) is not None}
    return "    ".join(f"{metric.label} {_formatted(metrics[n], metric.pattern)}" for n, metric in known.items())


def _formatted(value: object, pattern: str) -> str:
    return _escaped(written(value, pattern))


def _escaped(value: object) -> str:
    return html.escape(str(value), quote=True)
