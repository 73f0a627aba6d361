"""Distant surroundings of the reflective scenes: an equirectangular image, drawn in NumPy.

The convention is that of docs/conventions.md: z is up. The top row is the zenith, the bottom row the nadir. The centre
column is +x, the column a quarter from the left +y. The image is seen from inside, so that writing reads from left to
right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Array = NDArray[np.floating]
Color = tuple[float, float, float]

SUPERSAMPLING = 2
"""Samples per pixel and axis, which are averaged for smooth edges."""

ZENITH: Color = (0.10, 0.24, 0.62)
HORIZON: Color = (0.86, 0.76, 0.62)
NEAR_FLOOR: Color = (0.16, 0.12, 0.09)
FAR_FLOOR: Color = (0.34, 0.27, 0.20)
BLACK: Color = (0.02, 0.02, 0.03)
WHITE: Color = (0.85, 0.85, 0.85)


@dataclass(frozen=True)
class Panel:
    """A rectangle on the sphere of directions, bounded by meridians and parallels.

    Attributes:
        azimuth_deg: azimuth of the centre, from +x towards +y.
        elevation_deg: elevation of the centre above the horizon.
        size_deg: width in azimuth and height in elevation.
        color: linear radiance.
        panes: columns and rows of glass, separated by dark bars; (1, 1) is a plain rectangle.
    """

    azimuth_deg: float
    elevation_deg: float
    size_deg: tuple[float, float]
    color: Color
    panes: tuple[int, int] = (1, 1)


@dataclass(frozen=True)
class Sign:
    """White writing on a black board on the horizon at `azimuth_deg`; sizes as in `Panel`."""

    azimuth_deg: float
    elevation_deg: float
    size_deg: tuple[float, float]
    text: str


PANELS = (
    Panel(45.0, 40.0, (40.0, 30.0), (1.15, 1.12, 1.05), panes=(3, 2)),
    Panel(135.0, 24.0, (14.0, 34.0), (1.05, 0.16, 0.08)),
    Panel(162.0, 45.0, (16.0, 16.0), (1.10, 0.80, 0.10)),
    Panel(-135.0, 38.0, (30.0, 24.0), (0.95, 1.05, 1.20), panes=(2, 2)),
    Panel(-60.0, 40.0, (14.0, 26.0), (0.06, 0.75, 0.18)),
    Panel(-30.0, 26.0, (12.0, 30.0), (0.12, 0.25, 1.05)),
    Panel(0.0, 62.0, (40.0, 8.0), (1.20, 1.20, 1.20)),
    Panel(-110.0, 64.0, (60.0, 8.0), (1.10, 0.35, 0.90)),
)
SIGNS = (
    Sign(0.0, 12.0, (26.0, 16.0), "+x"),
    Sign(90.0, 12.0, (26.0, 16.0), "+y"),
    Sign(180.0, 12.0, (26.0, 16.0), "-x"),
    Sign(-90.0, 12.0, (26.0, 16.0), "-y"),
)


@dataclass(frozen=True)
class Surroundings:
    """Contents of an environment; the defaults are those of the named scenes.

    Attributes:
        zenith, horizon: colours of the sky, linear radiance.
        far_floor, near_floor: colours of the tiles at the horizon and at the nadir.
        panels: lamps and windows; later ones cover earlier ones.
        signs: boards with writing.
        charts: whether checkers, stripes and a skylight are drawn, for judging how sharp a recovered environment is.
    """

    zenith: Color = ZENITH
    horizon: Color = HORIZON
    far_floor: Color = FAR_FLOOR
    near_floor: Color = NEAR_FLOOR
    panels: tuple[Panel, ...] = PANELS
    signs: tuple[Sign, ...] = SIGNS
    charts: bool = True


NAMED = Surroundings()
SKYLIGHT_DEG = 72.0
"""Elevation above which bright fields around the zenith alternate with the sky."""
BAR_DEG = 1.2
"""Width of the dark bars and the frame of a window."""


def directions(height: int) -> Array:
    """Unit world directions [height, 2 height, 3] of the pixel centres of an equirectangular image."""
    azimuth = np.pi * (1 - 2 * (np.arange(2 * height) + 0.5) / (2 * height))
    polar = (np.pi * (np.arange(height) + 0.5) / height)[:, None]
    horizontal = np.sin(polar)
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.cos(polar) + 0 * azimuth], axis=-1)


def make_environment(height: int, surroundings: Surroundings = NAMED) -> NDArray[np.float32]:
    """Linear radiance [height, 2 height, 3], mostly within [0, 1]; lamps reach 1.2."""
    fine = height * SUPERSAMPLING
    direction = directions(fine)
    elevation_deg = np.degrees(np.arcsin(direction[..., 2]))
    azimuth_deg = np.degrees(np.arctan2(direction[..., 1], direction[..., 0]))
    radiance = _sky_and_floor(surroundings, azimuth_deg, elevation_deg)
    if surroundings.charts:
        _draw_bands(radiance, azimuth_deg, elevation_deg)
    for panel in surroundings.panels:
        _draw_panel(radiance, panel, azimuth_deg, elevation_deg)
    _draw_signs(radiance, surroundings.signs)
    blocks = radiance.reshape(height, SUPERSAMPLING, 2 * height, SUPERSAMPLING, 3)
    return blocks.mean(axis=(1, 3)).astype(np.float32)


def _blend(low: Color, high: Color, share: Array) -> Array:
    """Linear interpolation of colours [..., 3] from `low` (share 0) to `high` (share 1)."""
    return np.asarray(low) + share[..., None] * (np.asarray(high) - np.asarray(low))


def _sky_and_floor(surroundings: Surroundings, azimuth_deg: Array, elevation_deg: Array) -> Array:
    """A gradient above the horizon and tiles below, separated by a sharp line."""
    sky = _blend(surroundings.horizon, surroundings.zenith, np.clip(elevation_deg / 70, 0, 1) ** 0.7)
    floor = _blend(surroundings.far_floor, surroundings.near_floor, np.clip(-elevation_deg / 60, 0, 1))
    tiles = (np.floor(azimuth_deg / 15) + np.floor(elevation_deg / 7.5)) % 2
    return np.where((elevation_deg > 0)[..., None], sky, floor * (0.7 + 0.6 * tiles[..., None]))


def _draw_bands(radiance: Array, azimuth_deg: Array, elevation_deg: Array) -> None:
    """Fields, checkers and stripes of three widths, for judging how sharp a recovered environment is."""
    checkers = _inside(Panel(-125.0, 12.0, (24.0, 16.0), WHITE), azimuth_deg, elevation_deg)
    dark = (np.floor(azimuth_deg / 4) + np.floor(elevation_deg / 4)) % 2 == 0
    radiance[checkers] = np.where(dark[..., None], BLACK, WHITE)[checkers]
    skylight = elevation_deg > SKYLIGHT_DEG
    lit = (np.floor(azimuth_deg / 30) + np.floor((90 - elevation_deg) / 6)) % 2 == 0
    radiance[skylight & lit] = WHITE
    for middle_deg, width_deg in ((66.0, 3.0), (54.0, 2.0), (42.0, 1.5)):
        stripes = _inside(Panel(middle_deg, 12.0, (10.0, 16.0), WHITE), azimuth_deg, elevation_deg)
        dark = np.floor(azimuth_deg / width_deg) % 2 == 0
        radiance[stripes] = np.where(dark[..., None], BLACK, WHITE)[stripes]


def _offsets(panel: Panel, azimuth_deg: Array, elevation_deg: Array) -> tuple[Array, Array]:
    """Azimuth and elevation relative to the centre of a panel, in degrees."""
    return (azimuth_deg - panel.azimuth_deg + 180) % 360 - 180, elevation_deg - panel.elevation_deg


def _inside(panel: Panel, azimuth_deg: Array, elevation_deg: Array) -> NDArray[np.bool_]:
    """Mask of the pixels that a panel covers."""
    across, up = _offsets(panel, azimuth_deg, elevation_deg)
    return (np.abs(across) <= panel.size_deg[0] / 2) & (np.abs(up) <= panel.size_deg[1] / 2)


def _draw_panel(radiance: Array, panel: Panel, azimuth_deg: Array, elevation_deg: Array) -> None:
    """A lamp, or a window with a frame and bars."""
    inside = _inside(panel, azimuth_deg, elevation_deg)
    radiance[inside] = panel.color
    if panel.panes == (1, 1):
        return
    for offset, size, count in zip(
        _offsets(panel, azimuth_deg, elevation_deg), panel.size_deg, panel.panes, strict=True
    ):
        spacing = size / count
        from_bar = np.abs((offset + size / 2 + spacing / 2) % spacing - spacing / 2)
        radiance[inside & (from_bar < BAR_DEG / 2)] = BLACK


def _draw_signs(radiance: Array, signs: Sequence[Sign]) -> None:
    """Draws boards that show the name of their axis."""
    height, width = radiance.shape[:2]
    per_degree = height / 180
    for sign in signs:
        columns, rows = (round(size * per_degree) for size in sign.size_deg)
        board = Image.new("L", (columns, rows))
        font = ImageFont.load_default(size=0.95 * rows)
        ImageDraw.Draw(board).text((columns / 2, rows / 2), sign.text, fill=255, font=font, anchor="mm")
        left = round((180 - sign.azimuth_deg) * per_degree - columns / 2)
        top = round((90 - sign.elevation_deg) * per_degree - rows / 2)
        where = np.ix_(np.arange(top, top + rows), np.arange(left, left + columns) % width)
        radiance[where] = _blend(BLACK, WHITE, np.asarray(board) / 255.0)
