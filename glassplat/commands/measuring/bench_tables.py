"""Tables of a comparison: what each variant reaches, and by how much variants differ, with the spread over seeds."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from glassplat.files.markdown_table import Table


@dataclass(frozen=True)
class Column:
    """One metric.

    Attributes:
        name: in `results.json`.
        title: in the table.
        style: format specification of its values.
        is_ratio: compared by quotient, because absolute values differ between machines and scenes.
        of_planes: the planes' metric of which it is the mean over the scene's planes; empty for one of the scene.
    """

    name: str
    title: str
    style: str
    is_ratio: bool = False
    of_planes: str = ""


COLUMNS = (
    Column("psnr", "psnr", ".2f"),
    Column("corrected_psnr", "colours corrected", ".2f"),
    Column("right_half_psnr", "right halves", ".2f"),
    Column("ssim", "ssim", ".4f"),
    Column("lpips", "lpips", ".4f"),
    Column("pane_psnr", "pane psnr", ".2f"),
    Column("transmission_psnr", "transmission psnr", ".2f"),
    Column("reflection_psnr", "reflection psnr", ".2f"),
    Column("reflective_psnr", "reflective psnr", ".2f"),
    Column("normal_error_deg", "normal error, deg", ".2f"),
    Column("reflective_normal_error_deg", "reflective normal error, deg", ".2f"),
    Column("strength_error", "strength error", ".3f"),
    Column("environment_psnr", "environment psnr", ".2f"),
    Column("environment_lpips", "environment lpips", ".4f"),
    Column("num_gaussians", "Gaussians", ".0f", is_ratio=True),
    Column("train_seconds", "training, s", ".0f", is_ratio=True),
    Column("seconds_per_frame", "frame, s", ".4f", is_ratio=True),
    Column("pane_normal_error_deg", "pane normal error, deg", ".2f", of_planes="normal_error_deg"),
    Column("offset_error", "offset error", ".2%", of_planes="offset_error"),
    Column("base_reflectance_error", "R0 error", ".3f", of_planes="base_reflectance_error"),
)


@dataclass(frozen=True)
class Measured:
    """The metrics of one finished run; None where it has none."""

    scene: str
    variant: str
    seed: int
    values: Mapping[str, float | None]


class Pair(NamedTuple):
    """Two variants to compare: `variant` minus `baseline`."""

    title: str
    variant: str
    baseline: str


class Spread(NamedTuple):
    """Mean over the seeds and their standard deviation; None for a single seed."""

    mean: float
    deviation: float | None
    seeds: int


class Row(NamedTuple):
    """One line of a table."""

    scene: str
    title: str
    values: dict[str, Spread | None]


def values_of(results: Mapping[str, Any]) -> dict[str, float | None]:
    """The columns' values in `results.json`."""
    return {c.name: _mean_of_planes(results, c.of_planes) if c.of_planes else results.get(c.name) for c in COLUMNS}


def means(measured: Sequence[Measured]) -> list[Row]:
    """A row per scene and variant, in the order in which they come."""
    keys = dict.fromkeys((m.scene, m.variant) for m in measured)
    return [
        Row(scene, variant, _spreads([m.values for m in measured if (m.scene, m.variant) == (scene, variant)]))
        for scene, variant in keys
    ]


def differences(measured: Sequence[Measured], pairs: Sequence[Pair]) -> list[Row]:
    """A row per pair and scene, and one over all scenes where there are several; seed is compared with equal seed."""
    scenes = list(dict.fromkeys(m.scene for m in measured))
    rows = []
    for pair in pairs:
        by_scene = {scene: _compared(measured, scene, pair) for scene in scenes}
        rows += [Row(scene, pair.title, _spreads(list(seeds.values()))) for scene, seeds in by_scene.items() if seeds]
        compared = [seeds for seeds in by_scene.values() if seeds]
        if len(compared) > 1:
            rows.append(Row("mean", pair.title, _spreads(_over_scenes(compared))))
    return rows


def means_table(rows: Sequence[Row], title: str, note: str = "") -> Table:
    """Rows of means as markdown."""
    return _table(rows, title, note, signed=False)


def differences_table(rows: Sequence[Row], title: str, note: str = "") -> Table:
    """Rows of differences as markdown: differences with their sign, and quotients of counts and times."""
    return _table(rows, title, note, signed=True)


def plain_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Rows for JSON."""
    return [
        {"scene": row.scene, "title": row.title}
        | {name: None if spread is None else spread._asdict() for name, spread in row.values.items()}
        for row in rows
    ]


def _mean_of_planes(results: Mapping[str, Any], name: str) -> float | None:
    values = [plane[name] for plane in results.get("planes") or [] if plane.get(name) is not None]
    return statistics.fmean(values) if values else None


def _compared(measured: Sequence[Measured], scene: str, pair: Pair) -> dict[int, dict[str, float | None]]:
    """Differences and quotients of one scene by seed, for the seeds that both variants have."""
    found = {(m.variant, m.seed): m.values for m in measured if m.scene == scene}
    seeds = [seed for variant, seed in found if variant == pair.variant and (pair.baseline, seed) in found]
    return {seed: _difference(found[pair.variant, seed], found[pair.baseline, seed]) for seed in seeds}


def _difference(mine: Mapping[str, float | None], other: Mapping[str, float | None]) -> dict[str, float | None]:
    result: dict[str, float | None] = {}
    for column in COLUMNS:
        a, b = mine.get(column.name), other.get(column.name)
        if a is None or b is None or (column.is_ratio and not b):
            result[column.name] = None
        else:
            result[column.name] = a / b if column.is_ratio else a - b
    return result


def _over_scenes(by_scene: Sequence[Mapping[int, Mapping[str, float | None]]]) -> list[dict[str, float | None]]:
    """By seed, the mean over the scenes that have a value; seeds that not all scenes have would mix two means."""
    seeds = [seed for seed in by_scene[0] if all(seed in scene for scene in by_scene)]
    return [{c.name: _mean([scene[seed].get(c.name) for scene in by_scene]) for c in COLUMNS} for seed in seeds]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def _spreads(per_seed: Sequence[Mapping[str, float | None]]) -> dict[str, Spread | None]:
    return {column.name: _spread([values.get(column.name) for values in per_seed]) for column in COLUMNS}


def _spread(values: Sequence[float | None]) -> Spread | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    deviation = statistics.stdev(known) if len(known) > 1 else None
    return Spread(statistics.fmean(known), deviation, len(known))


def _table(rows: Sequence[Row], title: str, note: str, *, signed: bool) -> Table:
    """Columns without any value are left out."""
    columns = [column for column in COLUMNS if any(row.values[column.name] for row in rows)]
    titles = [f"{c.title.partition(',')[0]}, ratio" if signed and c.is_ratio else c.title for c in columns]
    table = Table(title, ("scene", "variant", *titles), note)
    for row in rows:
        table.add(row.scene, row.title, *(_text(row.values[column.name], column, signed) for column in columns))
    return table


def _text(spread: Spread | None, column: Column, signed: bool) -> str:
    if spread is None:
        return "-"
    style = ".3f" if signed and column.is_ratio else column.style
    sign = "+" if signed and not column.is_ratio else ""
    text = f"{spread.mean:{sign}{style}}"
    return text if spread.deviation is None else f"{text} ± {spread.deviation:{style}}"
