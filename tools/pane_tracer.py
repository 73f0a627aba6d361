"""A small exact ray tracer of luminous, matte things and thin panes, in numpy: what the laws of optics say, by itself.

Things shine with the radiance of their texture, the same in all directions, so that a picture has no noise. Panes are
thin: light goes through without a bend, and what comes back is the sum over all passages between the two surfaces.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tools.scene_surfaces import INK, solid_noise
from tools.tracer_panes import SELF, Array, Meeting, Pane

TEXTURE_WAVES = 16
REFLECTIONS = 3
"""How many reflections one after the other are followed."""


class Thing(Protocol):
    """Something opaque."""

    @property
    def seed(self) -> int:
        """Chooses its texture."""
        ...

    @property
    def shade(self) -> float:
        """Factor on the radiance of its texture."""
        ...

    def distances(self, origins: Array, directions: Array) -> Array:
        """How far [N] rays with unit directions go until they meet it; infinite where they do not."""
        ...

    def on_texture(self, points: Array) -> Array:
        """Where [N, 3] in the texture the points of its surface lie."""
        ...


@dataclass(frozen=True)
class Ball:
    """A ball."""

    center: tuple[float, float, float]
    radius: float
    seed: int
    shade: float = 1.0

    def distances(self, origins: Array, directions: Array) -> Array:
        """See `Thing`."""
        offset = origins - np.array(self.center)
        along = (offset * directions).sum(axis=1)
        discriminant = along**2 - (offset**2).sum(axis=1) + self.radius**2
        near = -along - np.sqrt(np.maximum(discriminant, 0))
        return np.where((discriminant > 0) & (near > 0), near, np.inf)

    def on_texture(self, points: Array) -> Array:
        """See `Thing`."""
        return points


@dataclass(frozen=True)
class Box:
    """A box along the axes, seen from outside, or as a room from inside; its texture as coarse as it is told."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    seed: int
    room: bool = False
    shade: float = 1.0
    coarseness: float = 1.0

    def distances(self, origins: Array, directions: Array) -> Array:
        """See `Thing`."""
        with np.errstate(divide="ignore"):
            to_low, to_high = (np.array(self.low) - origins) / directions, (np.array(self.high) - origins) / directions
        enters, leaves = np.minimum(to_low, to_high).max(axis=1), np.maximum(to_low, to_high).min(axis=1)
        if self.room:
            return leaves
        return np.where((enters < leaves) & (enters > 0), enters, np.inf)

    def on_texture(self, points: Array) -> Array:
        """See `Thing`."""
        return points / self.coarseness


@dataclass(frozen=True)
class Carried:
    """A thing that is carried about, its texture with it.

    Attributes:
        thing: as it is in a frame of its own.
        world_from_thing: [4, 4] rigid transform of that frame.
    """

    thing: Thing
    world_from_thing: Array

    @property
    def seed(self) -> int:
        """See `Thing`."""
        return self.thing.seed

    @property
    def shade(self) -> float:
        """See `Thing`."""
        return self.thing.shade

    def distances(self, origins: Array, directions: Array) -> Array:
        """See `Thing`."""
        return self.thing.distances(self.on_texture(origins), directions @ self.world_from_thing[:3, :3])

    def on_texture(self, points: Array) -> Array:
        """See `Thing`."""
        return (points - self.world_from_thing[:3, 3]) @ self.world_from_thing[:3, :3]


@dataclass(frozen=True)
class Silver:
    """An ellipsoid along the axes that mirrors all light, such as a bowl with its lid on.

    Attributes:
        center: world units.
        radii: along the axes.
    """

    center: tuple[float, float, float]
    radii: tuple[float, float, float]

    def distances(self, origins: Array, directions: Array) -> Array:
        """How far [N] rays from outside go until they meet it; infinite where they do not."""
        offset, along = (origins - self.center) / self.radii, directions / np.array(self.radii)
        square, middle = (along**2).sum(axis=1), -(offset * along).sum(axis=1)
        discriminant = middle**2 - square * ((offset**2).sum(axis=1) - 1)
        near = (middle - np.sqrt(np.maximum(discriminant, 0))) / square
        return np.where((discriminant > 0) & (near > SELF), near, np.inf)

    def normals(self, points: Array) -> Array:
        """Unit normals [N, 3] of points on it, outwards."""
        gradients = (points - self.center) / np.square(self.radii)
        return gradients / np.linalg.norm(gradients, axis=1, keepdims=True)


class Seen(NamedTuple):
    """What rays see.

    Attributes:
        radiance: [N, 3] linear, with all panes: (1 - strength) transmission + strength reflection.
        transmission: [N, 3] what comes through the first pane in its tint, with what panes behind it reflect.
        reflection: [N, 3] what the first pane would show as a perfect mirror; 0 without a pane.
        strength: [N] reflectance of the first pane.
        label: [N] the first pane's label, 0 where there is none.
        normal: [N, 3] of the silver in which a ray ends that goes straight through all panes, 0 where it does not.
    """

    radiance: Array
    transmission: Array
    reflection: Array
    strength: Array
    label: NDArray[np.uint8]
    normal: Array


@dataclass(frozen=True)
class Lamp:
    """Makes what is near it shine more: `power` times its texture at the centre, half of that at a distance `reach`."""

    center: tuple[float, float, float]
    reach: float
    power: float = 2.0

    def gains(self, points: Array) -> Array:
        """Radiance [N, 1] of points [N, 3] for that of their textures; photographs cut at 1 what is brighter."""
        return self.power / (1 + ((points - self.center) ** 2).sum(axis=1, keepdims=True) / self.reach**2)


@dataclass(frozen=True)
class Place:
    """Things and panes.

    Attributes:
        things: what there is; one must be a room, so that every ray ends.
        panes: glass and mirrors.
        lamp: without one all shine alike.
        photographer: things that stand where the rays come from: light meets them after a reflection only.
        silver: curved things that mirror everything.
    """

    things: Sequence[Thing]
    panes: Sequence[Pane]
    lamp: Lamp | None = None
    photographer: Sequence[Thing] = ()
    silver: Sequence[Silver] = ()

    def without_panes(self, origins: Array, directions: Array, reflections: int = REFLECTIONS) -> tuple[Array, Array]:
        """Radiance [N, 3] along rays that go straight through all panes, and how far [N] they go.

        Silver mirrors panes, too; where light meets it after so many reflections, it is not there for it.
        """
        radiance, distance = self.matte(origins, directions)
        if not reflections or not self.silver:
            return radiance, distance
        for points, normals, hit in self.silver_met(origins, directions, distance):
            along = (directions[hit] * normals).sum(axis=1, keepdims=True)
            onwards = directions[hit] - 2 * along * normals
            radiance[hit] = self.as_mirrored().radiance(points, onwards, reflections - 1)
            distance[hit] = np.linalg.norm(points - origins[hit], axis=1)
        return radiance, distance

    def silver_normals(self, origins: Array, directions: Array) -> Array:
        """[N, 3] of the silver in which rays end that go straight through all panes, 0 where they end elsewhere."""
        normals, distance = np.zeros_like(directions), self.matte(origins, directions)[1]
        for points, outwards, hit in self.silver_met(origins, directions, distance):
            normals[hit] = outwards
            distance[hit] = np.linalg.norm(points - origins[hit], axis=1)
        return normals

    def silver_met(
        self, origins: Array, directions: Array, distance: Array
    ) -> Iterator[tuple[Array, Array, NDArray[np.bool_]]]:
        """Of each silver thing where rays meet it [P, 3], its normals there, and which [N] rays these are.

        Args:
            origins: [N, 3] of the rays.
            directions: [N, 3] unit.
            distance: [N] how far they go, at most; asked anew for each thing.
        """
        for silver in self.silver:
            to_silver = silver.distances(origins, directions)
            hit = to_silver < distance
            points = origins[hit] + to_silver[hit, None] * directions[hit]
            yield points, silver.normals(points), hit

    def as_mirrored(self) -> Place:
        """The place as light sees it after a reflection: with the photographer."""
        return replace(self, things=(*self.things, *self.photographer), photographer=())

    def matte(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Radiance [N, 3] along rays of a place without panes and silver, and how far [N] they go."""
        distances = np.stack([thing.distances(origins, directions) for thing in self.things])
        distance, nearest = distances.min(axis=0), distances.argmin(axis=0)
        points = origins + distance[:, None] * directions
        radiance = np.empty_like(points)
        for number, thing in enumerate(self.things):
            of_it = nearest == number
            radiance[of_it] = thing.shade * painted(thing.on_texture(points[of_it]), thing.seed)
        return radiance if self.lamp is None else radiance * self.lamp.gains(points), distance

    def radiance(self, origins: Array, directions: Array, reflections: int = REFLECTIONS) -> Array:
        """Radiance [N, 3] along rays; panes that light meets after so many reflections are not there for it."""
        if not reflections or not len(origins) or not self.panes:
            return self.without_panes(origins, directions, reflections)[0]
        return self.seen(origins, directions, reflections).radiance

    def seen(self, origins: Array, directions: Array, reflections: int = REFLECTIONS) -> Seen:
        """The radiance along rays and its layers; there must be a pane."""
        radiance, end = self.without_panes(origins, directions, reflections)
        mirrored = self.as_mirrored()
        distances = np.stack([pane.distances(origins, directions) for pane in self.panes])
        distances = np.where(distances < end, distances, np.inf)
        order = distances.argsort(axis=0)
        # From the last pane on the way to the first one.
        for place in reversed(range(len(self.panes))):
            transmission, reflection = radiance.copy(), np.zeros_like(radiance)
            strength, label = np.zeros(len(end)), np.zeros(len(end), dtype=np.uint8)
            for number, pane in enumerate(self.panes):
                hit = (order[place] == number) & (distances[number] < np.inf)
                label[hit] = pane.label
                transmission[hit] *= pane.tint
                reflection[hit], strength[hit] = mirrored.mirrored_in(
                    pane.meetings(origins[hit], directions[hit], distances[number, hit]), reflections - 1
                )
            radiance = (1 - strength[:, None]) * transmission + strength[:, None] * reflection
        return Seen(radiance, transmission, reflection, strength, label, self.silver_normals(origins, directions))

    def mirrored_in(self, meetings: Sequence[Meeting], reflections: int) -> tuple[Array, Array]:
        """What a pane mirrors [N, 3], as if it mirrored all light, and the share [N] of the light that it does."""
        strength = np.sum([met.share for met in meetings], axis=0)
        seen = [met.share[:, None] * self.radiance(met.points, met.mirrored, reflections) for met in meetings]
        return np.sum(seen, axis=0) / np.maximum(strength, np.finfo(float).tiny)[:, None], strength


def painted(points: Array, seed: int) -> Array:
    """Radiance [N, 3] of a texture at points: patches of a few colours, some of them checked, with a fine grain."""
    level = solid_noise(points, frequency=0.7, seed=seed, waves=TEXTURE_WAVES)
    colors = INK[np.clip((level * len(INK)).astype(int), 0, len(INK) - 1)]
    checks = np.floor(points / 0.25 + 0.5).sum(axis=-1) % 2 == 0
    checked = solid_noise(points, frequency=0.4, seed=seed + 1, waves=TEXTURE_WAVES) > 0.5
    grain = 0.75 + 0.5 * solid_noise(points, frequency=6.0, seed=seed + 2, waves=TEXTURE_WAVES)
    shade = np.where(checks & checked, 0.45, 1.0) * grain
    return np.clip(colors * shade[:, None], 0.01, 1.0)
