"""Scene description for the pane tracer: objects, panes of glass, mirrors, silver, lamps, and scenes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from tools import pane_tracer
from tools.pane_tracer import REFLECTIONS, WAVES, Array, Seen, Tables, trace
from tools.scene_surfaces import INK

Pattern = Literal["patches", "stripes", "dots", "plain"]
PATTERNS: tuple[Pattern, ...] = ("patches", "stripes", "dots", "plain")
Triple = tuple[float, float, float]

FOCAL_PER_WIDTH = 0.85
SUBPIXELS = 3
"""Rays per pixel and axis."""
FREQUENCIES = (0.7, 0.4, 6.0)
"""Frequencies of patches, of the mask of their chequers, and of the grain; waves per pattern unit."""


@dataclass(frozen=True)
class Paint:
    """Radiance of a surface.

    Attributes:
        seed: random seed of the colours and the layout of the pattern.
        shade: scale factor of all colours.
        coarseness: size of a pattern unit, world units.
        pattern: patches of five colours, some of them chequered; stripes or dots of two colours; or one colour.
        glow: emitted linear radiance, which replaces all others; photographs clip above 1.
    """

    seed: int = 0
    shade: float = 1.0
    coarseness: float = 1.0
    pattern: Pattern = "patches"
    glow: Triple | None = None

    @property
    def code(self) -> int:
        """Code of the pattern in the tracer."""
        return pane_tracer.GLOW if self.glow else PATTERNS.index(self.pattern)

    @property
    def inks(self) -> Array:
        """[5, 3] radiances of the palette; stripes and dots use the first two, plain surfaces the first."""
        if self.glow:
            return np.tile(np.array(self.glow), (len(INK), 1))
        return INK if self.pattern == "patches" else np.random.default_rng(self.seed).permutation(INK)


@lru_cache(maxsize=4)
def camera_rays(width: int, height: int, subpixels: int, focal_per_width: float) -> Array:
    """Unit directions [H W S, 3] of the rays of an image in camera axes, `subpixels` squared for each pixel."""
    fine = (np.arange(subpixels) + 0.5) / subpixels
    x, y, dx, dy = np.meshgrid(np.arange(width), np.arange(height), fine, fine, indexing="xy")
    focal = focal_per_width * width
    rays = np.stack([(x + dx - width / 2) / focal, (y + dy - height / 2) / focal, np.ones_like(dx)], axis=-1)
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)


@lru_cache(maxsize=1024)
def paint_waves(seed: int) -> Array:
    """[3, 4, W] wave vectors in cycles per unit and phases in cycles, of the noises of `scene_surfaces.solid_noise`."""
    noises = []
    for offset, frequency in enumerate(FREQUENCIES):
        generator = np.random.default_rng(seed + offset)
        vectors = generator.normal(scale=frequency / np.sqrt(3), size=(WAVES, 3))
        noises.append([*vectors.T, generator.uniform(0, 1, WAVES)])
    return np.array(noises)


@dataclass(frozen=True)
class Ball:
    """A ball, or an ellipsoid whose height is `stretch` times its width."""

    center: Triple
    radius: float
    paint: Paint
    stretch: float = 1.0

    @property
    def span(self) -> Array:
        """[2, 3] lowest and highest corner of the bounding box."""
        half = self.radius * np.array([1.0, 1.0, self.stretch])
        return np.array([self.center - half, self.center + half])

    @property
    def shape(self) -> int:
        """Code of the shape in the tracer."""
        return pane_tracer.BALL


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, visible from outside, or from inside if it is a room."""

    low: Triple
    high: Triple
    paint: Paint
    room: bool = False

    @property
    def span(self) -> Array:
        """See `Ball`."""
        return np.array([self.low, self.high])

    @property
    def shape(self) -> int:
        """See `Ball`."""
        return pane_tracer.ROOM if self.room else pane_tracer.BOX


@dataclass(frozen=True)
class Cylinder:
    """A closed upright cylinder, elliptical if its footprint is not square."""

    low: Triple
    high: Triple
    paint: Paint

    @property
    def span(self) -> Array:
        """See `Ball`."""
        return np.array([self.low, self.high])

    @property
    def shape(self) -> int:
        """See `Ball`."""
        return pane_tracer.CYLINDER


@dataclass(frozen=True)
class Carried:
    """A rigidly moved object, together with its pattern.

    Attributes:
        thing: the object in its local frame.
        world_from_thing: [4, 4] rigid transform of that frame.
    """

    thing: Ball | Box | Cylinder
    world_from_thing: Array


Thing = Ball | Box | Cylinder | Carried


@dataclass(frozen=True)
class Silver:
    """An axis-aligned ellipsoid that reflects all light, such as a silver bowl with a lid.

    Attributes:
        center: world units.
        radii: radii along the axes.
    """

    center: Triple
    radii: Triple


@dataclass(frozen=True)
class Lamp:
    """A light that brightens near surfaces facing it: by `power` at its centre, by half of that at distance `reach`."""

    center: Triple
    reach: float
    power: float = 2.0


@dataclass(frozen=True)
class SecondPane:
    """The second pane of double glazing, with the reflectance of the first.

    Attributes:
        gap: distance behind the first pane, seen from the side to which the normal points, world units.
        tilt_rad: rotation about the tangent of the first pane.
    """

    gap: float
    tilt_rad: float


@dataclass(frozen=True)
class Pane:
    """A flat rectangle of glass, or a two-sided mirror.

    Attributes:
        label: number of the pane, starting at 1.
        center: world units.
        normal: unit.
        tangent: unit, along the first side.
        half_sizes: half the lengths of the sides.
        refraction: refractive index; None for a mirror.
        tint: transmittance for red, green and blue, applied to the light that is not reflected.
        second: second pane of double glazing; None for a single pane.
    """

    label: int
    center: Array
    normal: Array
    tangent: Array
    half_sizes: tuple[float, float]
    refraction: float | None = 1.5
    tint: Triple = (1.0, 1.0, 1.0)
    second: SecondPane | None = None

    @property
    def bitangent(self) -> Array:
        """Unit vector along the second side."""
        return np.cross(self.normal, self.tangent)

    @property
    def base_reflectance(self) -> float:
        """Reflectance at normal incidence, of both panes in double glazing."""
        once = pane_tracer.reflectance(1.0, self.refraction or 0.0)
        return float(once if self.second is None else once + once * (1 - once) ** 2)

    @property
    def second_plane(self) -> Array:
        """[2, 3] centre and normal of the second pane; those of the first without one."""
        second = self.second or SecondPane(0.0, 0.0)
        turned = np.cos(second.tilt_rad) * self.normal + np.sin(second.tilt_rad) * self.bitangent
        return np.array([self.center - second.gap * self.normal, turned])


def standing_pane(
    label: int,
    center: Triple,
    *,
    turn_deg: float,
    lean_deg: float,
    half_sizes: tuple[float, float],
    refraction: float | None = 1.5,
) -> Pane:
    """A pane with a level lower side: rotated about the vertical from facing -y, then leaning back."""
    axes = Rotation.from_euler("xz", [-lean_deg, turn_deg], degrees=True).as_matrix()
    return Pane(label, np.array(center), -axes[:, 1], axes[:, 0], half_sizes, refraction)


@dataclass(frozen=True)
class Place:
    """A scene of objects and panes.

    Attributes:
        things: objects; one must be a room, so that every ray ends.
        panes: panes of glass and mirrors.
        lamps: lights on objects; they are invisible themselves.
        ambient: ambient light, as a factor on the radiance of paints.
        photographer: objects at the camera, visible only after a reflection.
        silver: curved perfect mirrors.
    """

    things: Sequence[Thing]
    panes: Sequence[Pane]
    lamps: Sequence[Lamp] = ()
    ambient: float = 1.0
    photographer: Sequence[Thing] = ()
    silver: Sequence[Silver] = ()

    def seen(self, origins: Array, directions: Array, reflections: int = REFLECTIONS) -> Seen:
        """Traces rays [N, 3] with unit directions [N, 3]."""
        seen = trace(self.tables, origins, directions, reflections)
        labels = np.array([0, *(pane.label for pane in self.panes)], dtype=np.uint8)
        return seen._replace(label=labels[seen.label])

    def view(self, pose: Array, width: int, height: int) -> Seen:
        """Traces the rays of an image, `SUBPIXELS` squared for each pixel: [H, W, S, ...] each.

        Args:
            pose: [4, 4] camera-to-world: x right, y down, z forward.
            width: width of the image, pixels.
            height: height of the image, pixels.
        """
        directions = camera_rays(width, height, SUBPIXELS, FOCAL_PER_WIDTH) @ pose[:3, :3].T
        seen = self.seen(np.broadcast_to(pose[:3, 3], directions.shape), directions)
        return Seen(*(layer.reshape(height, width, SUBPIXELS**2, *layer.shape[1:]) for layer in seen))

    def without_panes(self) -> Place:
        """The same scene without glass and mirrors."""
        return replace(self, panes=())

    @cached_property
    def tables(self) -> Tables:
        """The scene as records for the tracer."""
        things = [*self.things, *self.photographer]
        return Tables(
            things=np.array([_thing_record(thing) for thing in things], dtype=pane_tracer.THING),
            direct=len(self.things),
            panes=np.array([_pane_record(pane) for pane in self.panes], dtype=pane_tracer.PANE),
            silver=np.array([_silver_record(silver) for silver in self.silver], dtype=pane_tracer.SILVER),
            lamps=np.array([(lamp.center, lamp.power, lamp.reach) for lamp in self.lamps], dtype=pane_tracer.LAMP),
            ambient=float(self.ambient),
        )


def _thing_record(thing: Thing) -> tuple[object, ...]:
    """Values of `pane_tracer.THING`."""
    turned, world_from_thing = isinstance(thing, Carried), np.eye(4)
    if isinstance(thing, Carried):
        world_from_thing, thing = thing.world_from_thing, thing.thing
    frame = np.linalg.inv(world_from_thing)
    low, high = thing.span
    paint, middle = thing.paint, world_from_thing @ [*(low + high) / 2, 1.0]
    pattern = (paint.code, paint.inks, paint.shade, paint.coarseness, paint_waves(paint.seed))
    # Slightly enlarged, so that rounding does not make a grazing ray miss.
    square_radius = 1.001 * ((high - low) ** 2).sum() / 4
    return (thing.shape, low, high, middle[:3], square_radius, turned, frame[:3], *pattern)


def _pane_record(pane: Pane) -> tuple[object, ...]:
    """Values of `pane_tracer.PANE`."""
    axes = (pane.center, pane.normal, pane.tangent, pane.bitangent)
    doubled = pane.second is not None
    return (*axes, pane.half_sizes, pane.refraction or 0.0, pane.tint, doubled, *pane.second_plane)


def _silver_record(silver: Silver) -> tuple[object, ...]:
    """Values of `pane_tracer.SILVER`."""
    center, radii = np.array(silver.center), np.array(silver.radii)
    return center, center - radii, center + radii
