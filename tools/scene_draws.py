"""Random glossy scenes: shapes, coatings, surroundings and a stand, generated from one seed.

Scenes on which a method was tuned say little about its generality. These scenes share only the setup of the named ones,
a glossy object on a matte patterned stand under distant light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tools.scene_environment import BLACK, Color, Panel, Surroundings
from tools.scene_surfaces import Triangles, placed, solid_noise, star_shaped, torus

Array = NDArray[np.floating]
Shape = Literal["ball", "egg", "box", "pebble", "torus"]
Coating = Literal["mirror", "metal", "glaze", "patterned glaze", "matte", "patterned"]

SHAPES: tuple[Shape, ...] = ("ball", "egg", "box", "pebble", "torus")
COATINGS: tuple[Coating, ...] = ("mirror", "metal", "glaze", "patterned glaze")
"""Reflective coatings to draw from."""
MATTE: tuple[Coating, ...] = ("matte", "patterned")
"""Coatings without specular reflection."""
SIZES = ((0.6, 0.75), (0.42, 0.5))
"""Smallest and largest radius of a single body, and of one of two, world units."""
DISTANCES = (0.0, 0.55)
"""Distance of bodies from the centre of the stand, for one and for two bodies."""


@dataclass(frozen=True)
class Body:
    """An object, usually a reflective one.

    Attributes:
        shape: kind of the shape.
        triangles: mesh of the shape, in its position.
        coating: a perfect mirror, a tinted one, a smooth clear coat over a matte colour or over patches, or these
            without the coat.
        tint: linear colour of the metal, or of the matte base.
        refraction: refractive index of the glaze.
        pattern_seed: random seed of the patches.
    """

    shape: Shape
    triangles: Triangles
    coating: Coating
    tint: Color
    refraction: float
    pattern_seed: int


@dataclass(frozen=True)
class Stand:
    """The disc below all bodies; attributes as in `scene_surfaces.disc` and `ground_texture`."""

    radius: float
    z: float
    checker_size: float
    pattern_seed: int


@dataclass(frozen=True)
class DrawnScene:
    """A random scene: bodies, stand and surroundings."""

    bodies: tuple[Body, ...]
    stand: Stand
    surroundings: Surroundings


def draw_scene(seed: int) -> DrawnScene:
    """The scene of a seed, deterministic."""
    generator = np.random.default_rng(seed)
    count = int(generator.integers(1, len(SIZES) + 1))
    bodies = tuple(_draw_body(generator, count, number) for number in range(count))
    height = max(float(body.triangles.positions[:, 2].max()) for body in bodies)
    # Bodies stand on z = 0 at first, but cameras aim slightly below the origin.
    down = np.array([0.0, 0.0, -height / 2])
    lowered = tuple(_moved(body, down) for body in bodies)
    stand = Stand(
        radius=float(generator.uniform(0.95, 1.25)),
        z=-height / 2,
        checker_size=float(generator.uniform(0.12, 0.4)),
        pattern_seed=int(generator.integers(1000)),
    )
    return DrawnScene(lowered, stand, _draw_surroundings(generator))


def _moved(body: Body, offset: Array) -> Body:
    return Body(**(vars(body) | {"triangles": placed(body.triangles, np.eye(3), offset)}))


def _draw_body(generator: np.random.Generator, count: int, number: int) -> Body:
    """One of `count` bodies, evenly spaced around the centre, on z = 0."""
    shape = SHAPES[generator.integers(len(SHAPES))]
    size = generator.uniform(*SIZES[count - 1])
    triangles = _draw_shape(generator, shape, size)
    angle = 2 * np.pi * number / count + generator.uniform(-0.1, 0.1)
    lowest = float(triangles.positions[:, 2].min())
    offset = np.array([DISTANCES[count - 1] * np.cos(angle), DISTANCES[count - 1] * np.sin(angle), -lowest])
    return Body(
        shape=shape,
        triangles=placed(triangles, np.eye(3), offset),
        coating=COATINGS[generator.integers(len(COATINGS))],
        tint=_color(generator, 0.05, 0.9),
        refraction=float(generator.uniform(1.6, 2.6)),
        pattern_seed=int(generator.integers(1000)),
    )


def _draw_shape(generator: np.random.Generator, shape: Shape, size: float) -> Triangles:
    """A shape about the origin with a radius of about `size`, randomly rotated unless that is invisible."""
    turn = Rotation.from_euler("zx", [generator.uniform(0, 360), generator.uniform(-25, 25)], degrees=True).as_matrix()
    if shape == "torus":
        thickness = generator.uniform(0.28, 0.42)
        return torus((1 - thickness) * size, thickness * size, tilt_deg=float(generator.uniform(20, 70)))
    return placed(star_shaped(_radius_function(generator, shape, size)), turn, np.zeros(3))


def _radius_function(generator: np.random.Generator, shape: Shape, size: float) -> Callable[[Array], Array]:
    """Distance of the surface from the centre, as a function of unit directions [..., 3]."""
    if shape == "ball":
        return lambda directions: size * np.ones(directions.shape[:-1])
    half_axes = size * generator.uniform(0.65, 1.0, 3)
    if shape == "egg":
        taper = generator.uniform(0.1, 0.3)
        return lambda d: (1 + taper * d[..., 2]) / (1 + taper) * np.sum((d / half_axes) ** 2, axis=-1) ** -0.5
    if shape == "box":
        power = generator.uniform(3.5, 6.0)
        return lambda d: 0.75 * np.sum(np.abs(d / half_axes) ** power, axis=-1) ** (-1 / power)
    depth, frequency, seed = generator.uniform(0.15, 0.35), generator.uniform(0.25, 0.45), int(generator.integers(1000))
    return lambda d: size * (1 - depth * solid_noise(d, frequency, seed))


def _draw_surroundings(generator: np.random.Generator) -> Surroundings:
    """A sky or a ceiling, a floor, and lamps and windows between them."""
    brightness = generator.uniform(0.15, 0.8)
    horizon = _color(generator, 0.5 * brightness, brightness)
    return Surroundings(
        zenith=_color(generator, 0.3 * brightness, brightness),
        horizon=horizon,
        far_floor=_color(generator, 0.1, 0.45),
        near_floor=_color(generator, 0.05, 0.3),
        panels=tuple(_draw_panel(generator, horizon) for _ in range(generator.integers(7, 15))),
        signs=(),
        charts=False,
    )


def _draw_panel(generator: np.random.Generator, horizon: Color) -> Panel:
    """A lamp, a window, or a dark object in front of the sky."""
    dark = generator.random() < 0.35
    panes = (int(generator.integers(1, 4)), int(generator.integers(1, 4)))
    return Panel(
        azimuth_deg=float(generator.uniform(-180, 180)),
        elevation_deg=float(generator.uniform(8, 65)),
        size_deg=(float(generator.uniform(10, 45)), float(generator.uniform(8, 32))),
        color=_color(generator, BLACK[0], 0.3 * max(horizon)) if dark else _color(generator, 0.3, 1.2),
        panes=(1, 1) if dark else panes,
    )


def _color(generator: np.random.Generator, low: float, high: float) -> Color:
    """Three channels, each within these bounds."""
    red, green, blue = generator.uniform(low, high, 3).tolist()
    return red, green, blue
