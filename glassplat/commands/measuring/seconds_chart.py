"""A chart of decibels against seconds as SVG, to be read in a browser or a page of documentation."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import NamedTuple

WIDTH, HEIGHT = 640, 360
LEFT, RIGHT, TOP, BOTTOM = 56, 120, 36, 44
COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44")
"""That colour-blind readers can tell apart (Paul Tol's bright scheme)."""
FONT = 'font-family="sans-serif" font-size="12"'
STEPS = (1, 2, 5)


class Curve(NamedTuple):
    """What a method reached: pairs of seconds and decibels."""

    name: str
    points: tuple[tuple[float, float], ...]


class Scale(NamedTuple):
    """A range of values along pixels."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        """The pixel of a value."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)


def chart(title: str, curves: Sequence[Curve]) -> str:
    """Curves with their axes, as the text of an SVG file; empty axes where there is no point."""
    seconds = [x for curve in curves for x, _ in curve.points] or [1.0]
    decibels = [y for curve in curves for _, y in curve.points] or [0.0]
    across = Scale(0.0, ticks(0.0, max(seconds))[-1], LEFT, WIDTH - RIGHT)
    marks = ticks(min(decibels), max(decibels))
    up = Scale(marks[0], marks[-1], HEIGHT - BOTTOM, TOP)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" {FONT}>',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        _text(LEFT, 20, title, anchor="start"),
        *(_row(up(mark), f"{mark:g}") for mark in marks),
        *(_text(across(mark), HEIGHT - BOTTOM + 18, f"{mark:g}") for mark in ticks(0.0, max(seconds))),
        _text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, "seconds of training"),
        _text(LEFT - 8, TOP - 6, "dB", anchor="end"),
        *(_drawn(curve, color, across, up) for curve, color in zip(curves, COLORS, strict=False)),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def ticks(low: float, high: float) -> list[float]:
    """Round numbers from one that is not above `low` to one that is not below `high`; at least two."""
    span = max(high - low, 1e-3)
    power = 10.0 ** math.floor(math.log10(span / 4))
    step = next(power * factor for factor in (*STEPS, 10) if span / (power * factor) <= 6)
    first, last = math.floor(low / step), max(math.ceil(high / step), math.floor(low / step) + 1)
    return [round(number * step, 9) for number in range(first, last + 1)]


def _drawn(curve: Curve, color: str, across: Scale, up: Scale) -> str:
    places = [(across(x), up(y)) for x, y in sorted(curve.points)]
    if not places:
        return ""
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{color}"/>' for x, y in places)
    x, y = places[-1]
    name = _text(x + 8, y + 4, curve.name, anchor="start", fill=color)
    return f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="2"/>{dots}{name}'


def _row(y: float, label: str) -> str:
    line = f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>'
    return line + _text(LEFT - 8, y + 4, label, anchor="end")


def _text(x: float, y: float, text: str, *, anchor: str = "middle", fill: str = "#333") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{fill}">{html.escape(text)}</text>'
