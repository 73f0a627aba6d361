"""Shapes of the demo scene: a shop window with curiosities, and the street in front of it.

World units are metres: x to the right along the shop front, y into the shop, z up; the pane lies in y = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

LEFT, RIGHT, BOTTOM, TOP = -1.25, 1.25, 0.55, 2.05
"""Extent of the pane."""
REFRACTION = 1.6
"""Refractive index of the pane."""
DEPTH = 0.95
"""Depth of the display behind the pane."""
FAR = -8.2
"""Position along y of the house fronts on the other side of the street."""
STREET_LAMP = (1.6, 1.25, 0.8)
"""Radiance of the lamps in the street."""


@dataclass(frozen=True)
class Shape:
    """Textured triangles.

    Attributes:
        vertices: [V, 3] positions.
        normals: [V, 3] unit, on the visible side.
        uv: [V, 2] texture coordinates; the texture repeats.
        faces: [F, 3] vertex indices.
        paint: name of the texture.
        glow: emitted linear radiance; 0 if the shape does not emit.
    """

    vertices: Array
    normals: Array
    uv: Array
    faces: NDArray[np.int64]
    paint: str
    glow: Triple | None = None

    def moved(self, offset: Triple, turn_deg: float = 0.0, scale: float = 1.0) -> Shape:
        """The shape scaled, rotated about the vertical, and shifted."""
        c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return replace(self, vertices=scale * self.vertices @ turn.T + offset, normals=self.normals @ turn.T)


def grid(points: Array, uv: Array, paint: str, normals: Array | None = None, glow: Triple | None = None) -> Shape:
    """A surface over a grid of points [H, W, 3]; without normals it faces (along rows) x (along columns)."""
    height, width = points.shape[:2]
    across = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    if normals is None:
        normals = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    is_turned = (across * normals).sum() < 0
    index = np.arange(height * width).reshape(height, width)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    faces = faces[:, ::-1] if is_turned else faces
    return Shape(points.reshape(-1, 3), normals.reshape(-1, 3), uv.reshape(-1, 2), faces, paint, glow)


def quad(
    corner: Triple, along: Triple, up: Triple, paint: str, *, spacing: float, picture: tuple[float, float] = (0.0, 0.0),
    glow: Triple | None = None,
) -> Shape:  # fmt: skip
    """A parallelogram that is visible from the side on which `along` points right and `up` points up.

    Args:
        corner: lower left corner.
        along: vector of the lower edge.
        up: vector of the left edge.
        paint: name of the texture.
        spacing: distance of the vertices, at which light is computed.
        picture: width and height of the texture in metres; 0 stretches it over the parallelogram.
        glow: see `Shape`.
    """
    u, v = np.array(along, float), np.array(up, float)
    sizes = np.linalg.norm(u), np.linalg.norm(v)
    columns, rows = (max(2, math.ceil(size / spacing) + 1) for size in sizes)
    s, t = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    points = np.array(corner) + s[..., None] * u + t[..., None] * v
    scale = [size / part if part else 1.0 for size, part in zip(sizes, picture, strict=True)]
    return grid(points, np.stack([s * scale[0], t * scale[1]], -1), paint, None, glow)


def box(
    low: Triple, high: Triple, paint: str, *, sides: str, spacing: float = 0.04,
    picture: tuple[float, float] = (0.5, 0.5), glow: Triple | None = None,
) -> list[Shape]:  # fmt: skip
    """Sides of a box: front (-y), back, left, right, top, bottom (f, k, l, r, t, b)."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    w, d, h = x1 - x0, y1 - y0, z1 - z0
    made = {
        "f": ((x0, y0, z0), (w, 0, 0), (0, 0, h)),
        "k": ((x1, y1, z0), (-w, 0, 0), (0, 0, h)),
        "l": ((x0, y1, z0), (0, -d, 0), (0, 0, h)),
        "r": ((x1, y0, z0), (0, d, 0), (0, 0, h)),
        "t": ((x0, y0, z1), (w, 0, 0), (0, d, 0)),
        "b": ((x0, y1, z0), (w, 0, 0), (0, -d, 0)),
    }
    return [quad(*made[side], paint, spacing=spacing, picture=picture, glow=glow) for side in sides]


def lathe(profile: Sequence[tuple[float, float]], paint: str, *, turns: int = 48, smooth: int = 8, repeat: float = 1.0,
          glow: Triple | None = None) -> Shape:  # fmt: skip
    """A surface of revolution about z through points (radius, height), from the lowest one.

    Args:
        profile: points of a smooth curve.
        paint: name of the texture.
        turns: number of segments around the axis.
        smooth: segments of the curve between two points of the profile; 1 keeps its corners.
        repeat: repetitions of the texture around the axis.
        glow: see `Shape`.
    """
    from scipy.interpolate import PchipInterpolator

    corners = np.array(profile, float)
    place = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    fine = np.linspace(0, place[-1], (len(corners) - 1) * smooth + 1) if smooth > 1 else place
    curve = PchipInterpolator(place, corners)(fine) if smooth > 1 else corners
    angle = np.linspace(0, 2 * math.pi, turns + 1)
    radius, height = curve[:, 0, None], np.broadcast_to(curve[:, 1, None], (len(curve), turns + 1))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
    slope = np.gradient(curve, axis=0)
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
    normals = np.stack(
        [slope[:, 1, None] * np.cos(angle), slope[:, 1, None] * np.sin(angle), -slope[:, 0, None] + 0 * angle], -1
    )
    s, t = np.meshgrid(repeat * np.linspace(0, 1, turns + 1), fine / place[-1])
    return grid(points, np.stack([s, t], -1), paint, normals, glow)


def tube(path: Array, radii: Array | float, paint: str, turns: int = 14) -> Shape:
    """A tube along points [N, 3]."""
    ahead = np.gradient(path, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, np.where(np.abs(ahead[:, 2:]) > 0.9, [[1.0, 0, 0]], [[0, 0, 1.0]]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(side, ahead)
    angle = np.linspace(0, 2 * math.pi, turns + 1)[:, None]
    normals = np.cos(angle) * side[:, None] + np.sin(angle) * other[:, None]
    points = path[:, None] + np.broadcast_to(np.asarray(radii, float), len(path))[:, None, None] * normals
    s, t = np.meshgrid(np.linspace(0, 1, turns + 1), np.linspace(0, 1, len(path)))
    return grid(points, np.stack([s, t], -1), paint, normals)


def ellipsoid(center: Triple, radii: Triple, paint: str, turns: int = 32, glow: Triple | None = None,
              tilt_deg: float = 0.0) -> Shape:  # fmt: skip
    """An ellipsoid, tilted about y."""
    a, b = np.meshgrid(np.linspace(0, 2 * math.pi, turns + 1), np.linspace(-math.pi / 2, math.pi / 2, turns // 2 + 1))
    unit = np.stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)], -1)
    normals = unit / np.array(radii)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    uv = np.stack([a / (2 * math.pi), b / math.pi + 0.5], -1)
    return grid((unit * radii) @ turn.T + center, uv, paint, normals @ turn.T, glow)


def slab(outline: Sequence[tuple[float, float]], thickness: float, paint: str, *, spacing: float = 0.05) -> list[Shape]:
    """An outline in x and z, convex or star-shaped about its mean and counter-clockwise from the front, with depth."""
    points = np.array(outline, float)
    middle = points.mean(axis=0)
    closed = np.concatenate([points, points[:1]])
    steps = np.linspace(0, 1, max(3, int(1 + np.ptp(points) / spacing / 3)))
    made = []
    for y, order in ((-thickness / 2, 1), (thickness / 2, -1)):
        ring = closed[::order]
        flat = middle + steps[:, None, None] * (ring - middle)
        surface = np.stack([flat[..., 0], np.full(flat.shape[:2], y), flat[..., 1]], -1)
        normals = np.broadcast_to([0.0, -order, 0.0], surface.shape)
        made.append(grid(surface, (flat - points.min(0)) / np.ptp(points, axis=0), paint, np.array(normals)))
    for (x0, z0), (x1, z1) in pairwise(closed):
        made.append(quad((x0, -thickness / 2, z0), (0, thickness, 0), (x1 - x0, 0, z1 - z0), paint, spacing=spacing))
    return made


def placed(shapes: Sequence[Shape], offset: Triple, turn_deg: float = 0.0, scale: float = 1.0) -> list[Shape]:
    """A group of shapes, moved together."""
    return [shape.moved(offset, turn_deg, scale) for shape in shapes]


def teapot() -> list[Shape]:
    """A porcelain teapot, 0.3 wide."""
    body = [(0.001, 0), (0.06, 0), (0.065, 0.01), (0.1, 0.05), (0.115, 0.1), (0.1, 0.15), (0.07, 0.175), (0.062, 0.18)]
    lid = [(0.066, 0.178), (0.05, 0.2), (0.02, 0.212), (0.012, 0.22), (0.02, 0.235), (0.012, 0.25), (0.001, 0.252)]
    s = np.linspace(0, 1, 24)[:, None]
    spout = (1 - s) ** 2 * [0.09, 0, 0.06] + 2 * s * (1 - s) * [0.19, 0, 0.06] + s**2 * [0.2, 0, 0.19]
    a = np.linspace(-1.25, 1.25, 24)
    handle = np.stack([-0.1 - 0.075 * np.cos(a), 0 * a, 0.1 + 0.062 * np.sin(a)], -1)
    return [
        lathe(body, "porcelain"), lathe(lid, "white"), tube(spout, np.linspace(0.028, 0.012, 24), "white"),
        tube(handle, 0.011, "white"),
    ]  # fmt: skip


def cup() -> list[Shape]:
    """A cup on its saucer."""
    a = np.linspace(-1.3, 1.3, 16)
    return [
        lathe([(0.001, 0.004), (0.04, 0.004), (0.075, 0.018), (0.078, 0.02)], "porcelain"),
        lathe([(0.001, 0.015), (0.022, 0.015), (0.03, 0.03), (0.045, 0.065), (0.048, 0.08)], "porcelain"),
        lathe([(0.046, 0.08), (0.04, 0.06), (0.001, 0.055)], "tea"),
        tube(np.stack([0.045 + 0.025 * np.cos(a), 0 * a, 0.05 + 0.022 * np.sin(a)], -1), 0.005, "white"),
    ]


def duck() -> list[Shape]:
    """A rubber duck."""
    return [
        ellipsoid((0, 0, 0.075), (0.12, 0.09, 0.075), "yellow"),
        ellipsoid((0.07, 0, 0.185), (0.062, 0.06, 0.06), "yellow"),
        ellipsoid((-0.11, 0, 0.115), (0.05, 0.035, 0.03), "yellow", tilt_deg=35),
        ellipsoid((-0.01, 0.08, 0.09), (0.07, 0.025, 0.04), "yellow"),
        ellipsoid((-0.01, -0.08, 0.09), (0.07, 0.025, 0.04), "yellow"),
        ellipsoid((0.135, 0, 0.178), (0.035, 0.03, 0.012), "orange"),
        ellipsoid((0.112, 0.036, 0.208), (0.013, 0.01, 0.014), "ink"),
        ellipsoid((0.112, -0.036, 0.208), (0.013, 0.01, 0.014), "ink"),
    ]


def globe() -> list[Shape]:
    """A globe in a brass ring on a wooden foot."""
    a = np.linspace(-1.45, 1.45, 40)
    ring = np.stack([0.185 * np.cos(a), 0 * a, 0.36 + 0.185 * np.sin(a)], -1)
    foot = [(0.001, 0), (0.12, 0), (0.12, 0.02), (0.06, 0.04), (0.02, 0.07), (0.03, 0.1), (0.015, 0.14), (0.02, 0.19)]
    return [
        ellipsoid((0, 0, 0.36), (0.165, 0.165, 0.165), "globe", 48, None, 20),
        tube(ring, 0.009, "brass"),
        lathe(foot, "mahogany"),
    ]


def gramophone() -> list[Shape]:
    """A box with a brass horn."""
    s = np.linspace(0, 1, 40)[:, None]
    path = (1 - s) ** 2 * [0, 0.12, 0.16] + 2 * s * (1 - s) * [0, 0.16, 0.5] + s**2 * [0.0, -0.12, 0.52]
    horn = tube(path, 0.012 + 0.19 * s[:, 0] ** 3.2, "brass", 40)
    inside = tube(path[8:], (0.012 + 0.19 * s[8:, 0] ** 3.2) * 0.985, "horn", 40)
    inside = replace(inside, normals=-inside.normals, faces=inside.faces[:, ::-1])
    record = lathe([(0.15, 0.178), (0.15, 0.182), (0.05, 0.183), (0.001, 0.183)], "record", smooth=1)
    label = lathe([(0.05, 0.184), (0.001, 0.1845)], "red", smooth=1)
    case = box((-0.18, -0.18, 0), (0.18, 0.18, 0.16), "mahogany", sides="fklrt", picture=(0.4, 0.4))
    plinth = box((-0.2, -0.2, 0), (0.2, 0.2, 0.03), "walnut", sides="fklrt")
    rim = box((-0.19, -0.19, 0.145), (0.19, 0.19, 0.17), "walnut", sides="fklrt")
    return [horn, inside, record.moved((0, -0.02, 0)), label.moved((0, -0.02, 0)), *case, *plinth, *rim]


def mantel_clock() -> list[Shape]:
    """A clock with a round top."""
    a = np.linspace(0, math.pi, 25)
    outline = [(-0.13, 0.0), (0.13, 0.0), *zip(0.13 * np.cos(a), 0.2 + 0.13 * np.sin(a), strict=True)]
    angle, r = np.meshgrid(np.linspace(0, 2 * math.pi, 49), np.linspace(0.0, 0.105, 12))
    face = np.stack([r * np.cos(angle), np.full(r.shape, -0.056), 0.2 + r * np.sin(angle)], -1)
    uv = np.stack([0.5 + r * np.cos(angle) / 0.22, 0.5 + r * np.sin(angle) / 0.22], -1)
    dial = grid(face, uv, "clock", np.broadcast_to([0.0, -1.0, 0.0], face.shape).copy())
    foot = box((-0.17, -0.08, -0.03), (0.17, 0.08, 0.005), "walnut", sides="fklrt")
    return placed([*slab(outline, 0.1, "mahogany"), dial, *foot], (0, 0, 0.03))


def boat() -> list[Shape]:
    """A model sailing boat on a stand."""
    t, side = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-math.pi / 2, math.pi / 2, 16))
    width = 0.055 * (1 - np.abs(t) ** 2.6)
    points = np.stack(
        [
            0.23 * t * (1 + 0.06 * np.cos(side)),
            width * np.sin(side),
            0.1 + 0.02 * t**2 - 0.075 * np.cos(side) * (1 - t**4),
        ],
        -1,
    )
    hull = grid(points, np.stack([t / 2 + 0.5, side / math.pi + 0.5], -1), "hull")
    hull = hull if (hull.normals[:, 2].mean() < 0) else replace(hull, normals=-hull.normals, faces=hull.faces[:, ::-1])
    edge = (
        np.stack([points[0, :, 0], points[0, :, 1], points[0, :, 2] - 0.006], -1),
        np.stack([points[-1, :, 0], points[-1, :, 1], points[-1, :, 2] - 0.006], -1),
    )
    deck = grid(np.stack(edge), np.stack([t[:2] * 2, side[:2]], -1), "planks")
    deck = deck if deck.normals[:, 2].mean() > 0 else replace(deck, normals=-deck.normals, faces=deck.faces[:, ::-1])
    mast = tube(np.linspace([0.02, 0, 0.1], [0.02, 0, 0.6], 20), 0.007, "walnut")
    main = slab([(-0.2, 0.17), (0.0, 0.16), (0.0, 0.58)], 0.006, "sail")
    jib = slab([(0.045, 0.16), (0.22, 0.15), (0.045, 0.5)], 0.006, "red")
    stand = box((-0.09, -0.05, 0), (0.09, 0.05, 0.03), "walnut", sides="fklrt")
    return [hull, deck, mast, *main, *jib, *stand]


def chess() -> list[Shape]:
    """A board with some pieces."""
    board = box((-0.2, -0.2, 0), (0.2, 0.2, 0.025), "walnut", sides="fklr")
    board.append(quad((-0.2, -0.2, 0.025), (0.4, 0, 0), (0, 0.4, 0), "chequers", spacing=0.02))
    base = [(0.001, 0), (0.018, 0), (0.018, 0.008), (0.009, 0.02)]
    kinds = {
        "pawn": [*base, (0.006, 0.035), (0.011, 0.04), (0.012, 0.05), (0.007, 0.058), (0.001, 0.06)],
        "rook": [*base, (0.009, 0.05), (0.015, 0.055), (0.015, 0.072), (0.001, 0.072)],
        "king": [*base, (0.008, 0.06), (0.015, 0.078), (0.01, 0.088), (0.004, 0.092), (0.004, 0.105), (0.001, 0.105)],
        "bishop": [*base, (0.007, 0.055), (0.012, 0.062), (0.009, 0.08), (0.001, 0.09)],
    }
    rows = [(0, "rook", "ink"), (3, "king", "ink"), (5, "bishop", "ink")]
    men = [(x, 7, kind, paint) for x, kind, paint in rows] + [(x, 6, "pawn", "ink") for x in (0, 1, 4, 5, 7)]
    men += [(7, 0, "rook", "ivory"), (4, 0, "king", "ivory"), (2, 0, "bishop", "ivory"), (5, 3, "bishop", "ivory")]
    men += [(x, 1, "pawn", "ivory") for x in (0, 1, 2, 6)] + [(3, 3, "pawn", "ivory"), (4, 4, "pawn", "ink")]
    return board + [
        lathe(kinds[kind], paint, turns=20, smooth=4).moved((-0.175 + 0.05 * x, -0.175 + 0.05 * y, 0.025), 0, 1.25)
        for x, y, kind, paint in men
    ]


def lamp() -> list[Shape]:
    """A table lamp whose shade glows."""
    foot = [(0.001, 0), (0.08, 0), (0.085, 0.015), (0.03, 0.04), (0.05, 0.1), (0.055, 0.15), (0.02, 0.22), (0.012, 0.3)]
    shade = lathe([(0.15, 0.26), (0.09, 0.44)], "white", smooth=6, glow=(1.0, 0.62, 0.32))
    top = lathe([(0.09, 0.44), (0.001, 0.44)], "white", smooth=1, glow=(1.0, 0.62, 0.32))
    return [lathe(foot, "vase"), shade, top]


def framed(width: float, height: float, paint: str, place: Triple) -> list[Shape]:
    """A painting in a golden frame on the back wall."""
    x, y, z = place
    rim = 0.035
    made = [quad((x, y, z), (width, 0, 0), (0, 0, height), paint, spacing=0.03)]
    for low, high in (
        ((x - rim, y - 0.02, z - rim), (x + width + rim, y + 0.02, z)),
        ((x - rim, y - 0.02, z + height), (x + width + rim, y + 0.02, z + height + rim)),
        ((x - rim, y - 0.02, z), (x, y + 0.02, z + height)),
        ((x + width, y - 0.02, z), (x + width + rim, y + 0.02, z + height)),
    ):
        made += box(low, high, "gilt", sides="flrtb", picture=(0.2, 0.2))
    return made


def display() -> list[Shape]:
    """The display behind the pane."""
    x0, x1, y1, z0, z1 = LEFT, RIGHT, DEPTH, BOTTOM, TOP + 0.18
    walls = [
        quad((x0, 0, z0), (x1 - x0, 0, 0), (0, y1, 0), "planks", spacing=0.025, picture=(0.9, 0.9)),
        quad((x0, y1, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0), "wallpaper", spacing=0.03, picture=(0.8, 0.8)),
        quad((x0, 0, z0), (0, y1, 0), (0, 0, z1 - z0), "panel", spacing=0.04, picture=(0.6, 0.6)),
        quad((x1, y1, z0), (0, -y1, 0), (0, 0, z1 - z0), "panel", spacing=0.04, picture=(0.6, 0.6)),
        quad((x0, y1, z1), (x1 - x0, 0, 0), (0, -y1, 0), "ceiling", spacing=0.05, picture=(1, 1)),
    ]
    shelf = box((0.15, y1 - 0.2, 1.42), (1.2, y1, 1.45), "walnut", sides="flrtb", spacing=0.03)
    books = quad((0.22, y1 - 0.17, 1.45), (0.62, 0, 0), (0, 0, 0.3), "spines", spacing=0.03)
    tops = quad((0.22, y1 - 0.17, 1.75), (0.62, 0, 0), (0, 0.15, 0), "paper", spacing=0.03)
    ends = [
        quad((0.84, y1 - 0.17, 1.45), (0, 0.15, 0), (0, 0, 0.3), "leather", spacing=0.03),
        quad((0.22, y1 - 0.02, 1.45), (0, -0.15, 0), (0, 0, 0.3), "leather", spacing=0.03),
    ]
    table = box((-0.35, 0.3, z0), (0.38, 0.72, z0 + 0.22), "velvet", sides="flrt", spacing=0.03)
    plinth = box((-1.12, 0.38, z0), (-0.7, 0.8, z0 + 0.14), "walnut", sides="flrt", spacing=0.03)
    pile = [s for n, (w, t) in enumerate(((0.3, 0.05), (0.27, 0.045), (0.24, 0.04))) for s in placed(
        box((-w / 2, -0.1, 0), (w / 2, 0.1, t), ("leather", "bluebook", "greenbook")[n], sides="flrt", spacing=0.03),
        (-0.42, 0.2, z0 + (0, 0.05, 0.095)[n]), (8, -12, 20)[n])]  # fmt: skip
    vase = lathe(
        [(0.001, 0), (0.06, 0), (0.065, 0.02), (0.12, 0.16), (0.125, 0.24), (0.06, 0.36), (0.05, 0.4), (0.075, 0.44)],
        "amphora",
    )
    lights = quad(
        (x0 + 0.1, 0.03, z1 - 0.01), (0, 0.13, 0), (x1 - x0 - 0.2, 0, 0), "white", spacing=0.2, glow=(17.0, 13.4, 9.4)
    )
    return [
        *walls, *shelf, books, tops, *ends, *table, *plinth, *pile, lights,
        *placed(globe(), (-0.92, 0.58, z0 + 0.14), 25, 1.05), *placed(gramophone(), (0.86, 0.5, z0), -18, 1.15),
        *placed(teapot(), (-0.05, 0.47, z0 + 0.22), 20, 1.15), *placed(cup(), (-0.25, 0.4, z0 + 0.22), 60, 1.1),
        *placed(cup(), (0.24, 0.42, z0 + 0.22), -40, 1.1), *placed(duck(), (-0.42, 0.2, z0 + 0.135), -60, 0.85),
        *placed(chess(), (0.2, 0.22, z0), 12, 0.8), *placed(mantel_clock(), (1.02, y1 - 0.1, 1.45), 0, 0.95),
        *placed(boat(), (-0.9, y1 - 0.2, 1.33), 8, 0.85), *placed([vase], (-0.62, 0.72, z0), 0, 1.15),
        *box((-1.2, y1 - 0.26, 1.3), (-0.6, y1, 1.33), "walnut", sides="flrtb", spacing=0.03),
        *placed(lamp(), (0.52, 0.74, z0), 0, 1.2), *framed(0.46, 0.34, "landscape", (-0.4, y1 - 0.01, 1.46)),
    ]  # fmt: skip


def shop_front() -> list[Shape]:
    """The wall around the pane: a painted wooden front with a door, a sign and bricks above."""
    paint, s = "green", 0.05
    made = []
    for low, high in (
        ((LEFT - 0.1, -0.05, 0.0), (RIGHT + 0.1, 0.02, BOTTOM)),  # below the pane
        ((LEFT - 0.1, -0.05, TOP), (RIGHT + 0.1, 0.02, TOP + 0.2)),
        ((LEFT - 0.1, -0.05, BOTTOM), (LEFT, 0.02, TOP)),
        ((RIGHT, -0.05, BOTTOM), (RIGHT + 0.1, 0.02, TOP)),
        ((LEFT - 0.15, -0.12, BOTTOM - 0.06), (RIGHT + 0.15, 0.0, BOTTOM - 0.01)),  # sill
        ((LEFT - 0.4, -0.09, 0.0), (LEFT - 0.1, 0.0, TOP + 0.1)),  # pilasters
        ((RIGHT + 0.1, -0.09, 0.0), (RIGHT + 0.4, 0.0, TOP + 0.1)),
        ((LEFT - 0.4, -0.14, TOP + 0.55), (RIGHT + 1.6, 0.0, TOP + 0.65)),  # cornice
    ):
        made += box(low, high, paint, sides="flrtb", spacing=s, picture=(0.8, 0.8))
    for x in (-0.95, -0.3, 0.35):
        made += box((x, -0.075, 0.12), (x + 0.58, -0.04, 0.42), "darkgreen", sides="flrtb", spacing=s)
    made.append(quad((LEFT - 0.4, -0.1, TOP + 0.1), (RIGHT - LEFT + 2.0, 0, 0), (0, 0, 0.45), "sign", spacing=s))
    made += box(
        (RIGHT + 0.45, -0.04, 0.0), (RIGHT + 1.45, 0.0, TOP + 0.1), "door", sides="flr", spacing=s, picture=(0, 0)
    )
    made.append(lathe([(0.03, 0), (0.035, 0.02), (0.001, 0.04)], "brass", turns=16).moved((RIGHT + 0.56, -0.08, 1.05)))
    for corner, width, height in (
        ((RIGHT + 1.45, 0, 0), 5.0, 6.5), ((LEFT - 5.4, 0, 0), 5.0, 6.5),
        ((LEFT - 0.4, 0, TOP + 0.65), RIGHT - LEFT + 2.25, 4.0),
    ):  # fmt: skip
        made.append(quad(corner, (width, 0, 0), (0, 0, height), "bricks", spacing=0.15, picture=(1.8, 1.2)))
    for x in (-0.75, 1.2):
        made += box((x, -0.06, 3.4), (x + 1.0, 0, 3.5), "cream", sides="flrtb", spacing=0.1)
        made.append(quad((x + 0.08, -0.02, 3.5), (0.84, 0, 0), (0, 0, 1.4), "window", spacing=0.1))
    return made


def tree(place: Triple, seed: int) -> list[Shape]:
    """A trunk with a crown of leaves."""
    draw = np.random.default_rng(seed)
    made = [lathe([(0.13, 0), (0.1, 0.5), (0.08, 1.9)], "bark", turns=14).moved(place)]
    for _ in range(9):
        offset = draw.normal(size=3) * [0.5, 0.5, 0.4] + [0, 0, 2.6]
        radius = draw.uniform(0.45, 0.7)
        ball = ellipsoid((0, 0, 0), (radius, radius, 0.85 * radius), "leaves", 26)
        bump = 1 + 0.12 * np.sin(9 * ball.vertices @ draw.normal(size=3) + draw.uniform(0, 6))[:, None]
        made.append(replace(ball, vertices=ball.vertices * bump, uv=2 * ball.uv).moved(tuple(np.array(place) + offset)))
    return made


def car(place: Triple) -> list[Shape]:
    """A small red car, seen from its side."""
    body = [(-1.75, 0.3), (1.75, 0.3), (1.82, 0.6), (1.7, 0.8), (0.95, 0.92), (-1.0, 0.95), (-1.7, 0.85), (-1.82, 0.55)]
    cabin = [(-1.1, 0.9), (1.0, 0.9), (0.55, 1.38), (0.3, 1.45), (-0.6, 1.45), (-0.85, 1.38)]
    glass = [(-0.95, 0.95), (0.8, 0.95), (0.45, 1.34), (-0.7, 1.34)]
    made = [*slab(body, 1.5, "carpaint", spacing=0.15), *slab(cabin, 1.3, "carpaint", spacing=0.15)]
    made += slab(glass, 1.32, "carglass", spacing=0.15)
    made += box((-0.04, -0.67, 0.93), (0.04, 0.67, 1.4), "carpaint", sides="fk")
    for x in (-1.1, 1.1):
        a = np.linspace(0, 2 * math.pi, 33)[:-1]
        for radius, depth, paint in ((0.34, 1.54, "rubber"), (0.2, 1.56, "chrome")):
            ring = list(zip(x + radius * np.cos(a), 0.34 + radius * np.sin(a), strict=True))
            made += slab(ring, depth, paint, spacing=0.1)
    made.append(ellipsoid((1.72, -0.55, 0.66), (0.1, 0.12, 0.12), "headlight"))
    made.append(ellipsoid((1.72, 0.55, 0.66), (0.1, 0.12, 0.12), "headlight"))
    return placed(made, place)


def houses() -> list[Shape]:
    """Four houses on the other side, with roofs and sills."""
    made = []
    fronts = (("house1", 7.4, 5.6), ("house2", 6.6, 4.4), ("house3", 7.9, 4.6), ("house4", 6.9, 4.4))
    right = 9.5
    for name, height, width in fronts:
        made.append(quad((right, FAR, 0), (-width, 0, 0), (0, 0, height), name, spacing=0.13))
        made += placed(
            box((-width, -0.25, height), (0, 0.12, height + 0.2), "cream", sides="kflrtb", spacing=0.2), (right, FAR, 0)
        )
        eaves = (right, FAR, height + 0.2)
        made.append(quad(eaves, (-width, 0, 0), (0, -1.2, 1.3), "tiles", spacing=0.2, picture=(1.2, 1.2)))
        for column in (0.13, 0.42, 0.71):
            x = right - width * column - 0.05 * width
            for top in (height * 0.54, height * 0.795):
                low, high = (x - 0.55, FAR, top - 0.08), (x + 0.1, FAR + 0.16, top)
                made += box(low, high, "cream", sides="kflrtb", spacing=0.12)
        right -= width
    return made


def cafe() -> list[Shape]:
    """The awning of a café, with tables and chairs in front."""
    awning = quad((9.2, FAR + 0.02, 2.4), (-5.0, 0, 0), (0, 1.1, -0.5), "awning", spacing=0.12, picture=(2.5, 0))
    under = replace(
        awning, normals=-awning.normals, faces=awning.faces[:, ::-1], vertices=awning.vertices - [0, 0, 0.01]
    )
    made = [awning, under]
    table = [(0.2, 0), (0.03, 0.04), (0.03, 0.68), (0.36, 0.7), (0.36, 0.73), (0.001, 0.73)]
    for x in (5.0, 6.4, 7.8):
        made.append(lathe(table, "white", turns=24, smooth=1).moved((x, FAR + 0.95, 0)))
        for side, paint in ((-0.55, "red"), (0.55, "blue")):
            made += placed(
                box((-0.18, -0.18, 0.38), (0.18, 0.18, 0.43), paint, sides="fklrtb"), (x + side, FAR + 0.95, 0)
            )
            made += placed(
                box((-0.18, -0.02, 0.43), (0.18, 0.02, 0.85), paint, sides="fklrt"), (x + side, FAR + 0.8, 0)
            )
            made += placed(box((-0.16, -0.16, 0.0), (0.16, 0.16, 0.38), "ink", sides="fklr"), (x + side, FAR + 0.95, 0))
    return made


def street() -> list[Shape]:
    """Pavements, the road, houses on the other side, a café, trees, lamps, a bench and a car."""
    made = [
        quad((-9, -2.4, 0), (18, 0, 0), (0, 2.4, 0), "paving", spacing=0.12, picture=(1.6, 1.6)),
        quad((-9, -2.4, -0.12), (18, 0, 0), (0, 0, 0.12), "kerb", spacing=0.2, picture=(1, 1)),
        quad((-9, -6.4, -0.12), (18, 0, 0), (0, 4.0, 0), "road", spacing=0.15, picture=(8, 4)),
        quad((9, -6.4, -0.12), (-18, 0, 0), (0, 0, 0.12), "kerb", spacing=0.2, picture=(1, 1)),
        quad((-9, FAR, 0), (18, 0, 0), (0, 1.8, 0), "paving", spacing=0.15, picture=(1.6, 1.6)),
        *houses(),
        *cafe(),
    ]
    made += [
        s for n, (x, y) in enumerate(((-3.6, FAR + 1.2), (2.2, FAR + 1.2), (-4.6, -1.9))) for s in tree((x, y, 0), n)
    ]
    for x, y in ((3.4, -1.95), (-0.6, FAR + 1.3)):
        post = [(0.12, 0), (0.12, 0.3), (0.05, 0.5), (0.04, 2.9), (0.07, 3.0)]
        made.append(lathe(post, "ink", turns=20).moved((x, y, 0)))
        made.append(ellipsoid((x, y, 3.2), (0.22, 0.22, 0.24), "white", 24, STREET_LAMP))
        made.append(lathe([(0.24, 3.4), (0.05, 3.5), (0.001, 3.56)], "ink", turns=20).moved((x, y, 0)))
    made += placed(car((0, 0, -0.12)), (-1.9, -5.5, 0))
    made += box((-3.2, -1.9, 0.42), (-1.7, -1.45, 0.48), "oak", sides="fklrtb", spacing=0.08)
    made += box((-3.2, -1.93, 0.55), (-1.7, -1.87, 0.95), "oak", sides="fklrtb", spacing=0.08)
    for x in (-3.05, -1.9):
        made += box((x, -1.88, 0), (x + 0.06, -1.5, 0.42), "ink", sides="fklr", spacing=0.1)
    made += box((4.3, -1.95, 0), (4.75, -1.55, 1.25), "postbox", sides="fklrt", spacing=0.08, picture=(0, 0))
    return made


def all_shapes() -> list[Shape]:
    """All shapes of the scene, without the pane."""
    return [*display(), *shop_front(), *street()]
