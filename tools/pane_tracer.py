"""An exact ray tracer for matte emissive objects, thin panes and curved mirrors, compiled with Numba.

Objects emit the radiance of their paint under the lamps equally in all directions, so images have no noise. Panes are
thin: light passes without a bend, and their reflectance sums all multiple reflections between the two surfaces, by
Fresnel's law for each polarisation. Paths have up to `REFLECTIONS` successive reflections. `tools/pane_things.py`
describes scenes; this file traces rays through their tables.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array = NDArray[np.float64]

REFLECTIONS = 3
"""Maximum number of successive reflections along a path."""
SELF = 1e-6
"""Minimum hit distance, world units, so that a ray does not hit the pane from which it starts."""
BALL, BOX, ROOM, CYLINDER = range(4)
PATCHES, STRIPES, DOTS, PLAIN, GLOW = range(5)
CHECK, STRIPE, DOT_SPACING, DOT_RADIUS = 0.25, 0.11, 0.22, 0.33
"""Sizes in patterns, in pattern units; the radius of dots is a share of their spacing."""
# Minimax polynomial of cos(2 pi x) in x^2 on [-1/2, 1/2], exact to 1e-12: unlike `math.cos` it is vectorised.
C0, C1, C2 = 0.9999999999990647, -19.73920880157127, 64.93939395775345
C3, C4, C5 = -85.45681453437972, 60.24458621793278, -26.42561649473334
C6, C7, C8 = 7.899159802271778, -1.696874443601398, 0.24376212211887036


WAVES, INKS = 16, 5
THING = np.dtype(
    [
        ("shape", "i8"),  # `BALL`, `BOX`, `ROOM` or `CYLINDER`
        ("low", "f8", 3),  # corners of its bounding box in its frame
        ("high", "f8", 3),
        ("middle", "f8", 3),  # of its bounding sphere, in the world, with the squared radius
        ("square_radius", "f8"),
        ("turned", "i8"),  # whether the frame differs from the world's
        ("frame", "f8", (3, 4)),  # thing_from_world, rigid
        ("pattern", "i8"),  # pattern of the paint
        ("inks", "f8", (INKS, 3)),  # colours of the paint; the radiance of emitters
        ("shade", "f8"),  # scale factor of the colours
        ("scale", "f8"),  # world units per pattern unit
        ("waves", "f8", (3, 4, WAVES)),  # three noises: wave vectors in cycles per unit, phases in cycles
    ]
)
PANE = np.dtype(
    [
        ("center", "f8", 3),
        ("normal", "f8", 3),
        ("tangent", "f8", 3),
        ("bitangent", "f8", 3),
        ("half_sizes", "f8", 2),
        ("refraction", "f8"),  # refractive index, 0 for mirrors
        ("tint", "f8", 3),
        ("doubled", "i8"),  # whether there is a second pane
        ("second_center", "f8", 3),
        ("second_normal", "f8", 3),
    ]
)
SILVER = np.dtype([("center", "f8", 3), ("low", "f8", 3), ("high", "f8", 3)])
LAMP = np.dtype([("center", "f8", 3), ("power", "f8"), ("reach", "f8")])


class Tables(NamedTuple):
    """A scene as records for compiled code.

    Attributes:
        things: records of `THING`.
        direct: number of objects that are directly visible; the remaining ones are visible only after a reflection.
        panes: records of `PANE`.
        silver: records of `SILVER`.
        lamps: records of `LAMP`.
        ambient: ambient light, as a factor on inks.
    """

    things: np.ndarray
    direct: int
    panes: np.ndarray
    silver: np.ndarray
    lamps: np.ndarray
    ambient: float


class Seen(NamedTuple):
    """Results of tracing rays.

    Attributes:
        radiance: [N, 3] linear, with all panes: (1 - strength) transmission + strength reflection.
        transmission: [N, 3] radiance through the first pane with its tint, including reflections in panes behind it.
        reflection: [N, 3] radiance if the first pane were a perfect mirror; 0 without a pane.
        strength: [N] reflectance of the first pane.
        label: [N] number of the first pane, starting at 1; 0 without one.
        normal: [N, 3] normal of the silver that the ray, passing straight through all panes, ends on; else 0.
        distance: [N] to the object or silver that this ray ends on.
        to_pane: [N] distance to the first pane, infinite without one.
    """

    radiance: Array
    transmission: Array
    reflection: Array
    strength: Array
    label: NDArray[np.uint8]
    normal: Array
    distance: Array
    to_pane: Array


def trace(tables: Tables, origins: Array, directions: Array, reflections: int = REFLECTIONS) -> Seen:
    """Trace rays [N, 3] with unit directions [N, 3]; panes are ignored after `reflections` reflections."""
    count = len(directions)
    colors, scalars, labels = np.zeros((count, 4, 3)), np.zeros((count, 3)), np.zeros(count, dtype=np.uint8)
    rays = np.ascontiguousarray(origins, dtype=float), np.ascontiguousarray(directions, dtype=float)
    _trace_rays(tables, *rays, reflections, (colors, scalars, labels))
    radiance, transmission, reflection, normal = np.moveaxis(colors, 1, 0)
    strength, distance, to_pane = scalars.T
    return Seen(radiance, transmission, reflection, strength, labels, normal, distance, to_pane)


@njit(cache=True)
def dot(a, b):
    """Product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def moved(point, factor, step):
    """Point + factor * step."""
    return point[0] + factor * step[0], point[1] + factor * step[1], point[2] + factor * step[2]


@njit(cache=True)
def vector(row):
    """The first three values of a row as a tuple, which needs no allocation."""
    return row[0], row[1], row[2]


@njit(cache=True)
def minus(a, b):
    """Difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def mirrored(direction, normal):
    """The direction after a reflection."""
    return moved(direction, -2.0 * dot(direction, normal), normal)


@njit(cache=True, parallel=True)
def _trace_rays(tables, origins, directions, reflections, outputs):
    for number in prange(len(directions)):
        _trace_ray(tables, (vector(origins[number]), vector(directions[number])), reflections, number, outputs)


@njit(cache=True)
def _trace_ray(tables, ray, reflections, number, outputs):
    """Traces one ray and writes a row of the outputs."""
    colors, scalars, labels = outputs
    origin, direction = ray
    normal, end = _silver_end(tables, origin, direction, _nearest_thing(tables, origin, direction, False)[0])
    pane, to_pane = -1, np.inf
    if reflections > 0:
        pane, reached = _next_pane(tables, origin, direction, (SELF, end))
        to_pane = reached if pane >= 0 else np.inf
    stack = np.empty((1 + REFLECTIONS * (2 * len(tables.panes) + 1), 11))
    start = moved(origin, to_pane, direction) if pane >= 0 else origin
    trans = _radiance(tables, (start, direction), reflections, False, stack)
    reflection, strength = (0.0, 0.0, 0.0), 0.0
    if pane >= 0:
        tint = tables.panes[pane].tint
        trans = trans[0] * tint[0], trans[1] * tint[1], trans[2] * tint[2]
        for met in range(1 + tables.panes[pane].doubled):
            point, onwards, share = _meeting(tables.panes[pane], met, ray)
            reflection = moved(reflection, share, _radiance(tables, (point, onwards), reflections - 1, True, stack))
            strength += share
        reflection = moved((0.0, 0.0, 0.0), 1.0 / max(strength, 1e-300), reflection)
    for c in range(3):
        colors[number, 0, c] = (1 - strength) * trans[c] + strength * reflection[c]
        colors[number, 1, c], colors[number, 2, c], colors[number, 3, c] = trans[c], reflection[c], normal[c]
    labels[number] = pane + 1
    scalars[number, 0], scalars[number, 1], scalars[number, 2] = strength, end, to_pane


@njit(cache=True)
def _radiance(tables, ray, reflections, after_mirror, stack):
    """Radiance along a ray: the sum over all light paths of their throughput times the emitted radiance.

    Args:
        tables: records of the scene.
        ray: origin and unit direction.
        reflections: remaining number of reflections.
        after_mirror: whether the ray was reflected before, so that it may hit the photographer.
        stack: [D, 11] scratch of pending paths: origin, direction, throughput, reflections, after_mirror.
    """
    top = _push(stack, 0, ray, ((1.0, 1.0, 1.0), reflections, after_mirror))
    red, green, blue = 0.0, 0.0, 0.0
    while top > 0:
        top -= 1
        row = stack[top]
        origin, direction, share = (row[0], row[1], row[2]), (row[3], row[4], row[5]), (row[6], row[7], row[8])
        left, after = int(row[9]), row[10] > 0
        end, thing = _nearest_thing(tables, origin, direction, after)
        normal, silver_end = (0.0, 0.0, 0.0), end
        if left > 0:
            normal, silver_end = _silver_end(tables, origin, direction, end)
            reached = SELF
            while True:
                pane, reached = _next_pane(tables, origin, direction, (reached, silver_end))
                if pane < 0:
                    break
                strength = 0.0
                for met in range(1 + tables.panes[pane].doubled):
                    point, onwards, part = _meeting(tables.panes[pane], met, (origin, direction))
                    returned = moved((0.0, 0.0, 0.0), part, share)
                    top = _push(stack, top, (point, onwards), (returned, left - 1, True))
                    strength += part
                tint = tables.panes[pane].tint
                through = 1.0 - strength
                share = share[0] * through * tint[0], share[1] * through * tint[1], share[2] * through * tint[2]
        point = moved(origin, silver_end, direction)
        if silver_end < end:
            top = _push(stack, top, (point, mirrored(direction, normal)), (share, left - 1, True))
        else:
            color = _shining(tables, tables.things[thing], point)
            red, green, blue = red + share[0] * color[0], green + share[1] * color[1], blue + share[2] * color[2]
    return red, green, blue


@njit(cache=True)
def _push(stack, top, ray, state):
    """Pushes a pending path; returns the new size of the stack."""
    for c in range(3):
        stack[top, c], stack[top, 3 + c], stack[top, 6 + c] = ray[0][c], ray[1][c], state[0][c]
    stack[top, 9], stack[top, 10] = state[1], 1.0 if state[2] else 0.0
    return top + 1


@njit(cache=True)
def _nearest_thing(tables, origin, direction, after_mirror):
    """Distance and index of the first object on a ray."""
    nearest, found = np.inf, -1
    for number in range(len(tables.things) if after_mirror else tables.direct):
        thing = tables.things[number]
        offset = minus(vector(thing.middle), origin)
        along = dot(offset, direction)
        if dot(offset, offset) - along * along > thing.square_radius:
            continue
        distance = distance_to(thing, origin, direction)
        if distance < nearest:
            nearest, found = distance, number
    return nearest, found


@njit(cache=True)
def _in_frame(frame, point, w):
    """A point (w = 1) or direction (w = 0) in the frame of an object."""
    return (
        frame[0, 0] * point[0] + frame[0, 1] * point[1] + frame[0, 2] * point[2] + w * frame[0, 3],
        frame[1, 0] * point[0] + frame[1, 1] * point[1] + frame[1, 2] * point[2] + w * frame[1, 3],
        frame[2, 0] * point[0] + frame[2, 1] * point[1] + frame[2, 2] * point[2] + w * frame[2, 3],
    )


@njit(cache=True)
def distance_to(thing, origin, direction):
    """Distance along a ray to an object; infinite if it misses."""
    if thing.turned:
        origin, direction = _in_frame(thing.frame, origin, 1.0), _in_frame(thing.frame, direction, 0.0)
    low, high = vector(thing.low), vector(thing.high)
    if thing.shape == BALL:
        enters, leaves = _through_ellipsoid(low, high, 3, (origin, direction))
        return enters if 0 < enters < leaves else np.inf
    enters, leaves = _through_slab(low[2], high[2], origin[2], direction[2])
    if thing.shape == CYLINDER:
        first, last = _through_ellipsoid(low, high, 2, (origin, direction))
        enters, leaves = max(enters, first), min(leaves, last)
    else:
        for axis in range(2):
            first, last = _through_slab(low[axis], high[axis], origin[axis], direction[axis])
            enters, leaves = max(enters, first), min(leaves, last)
        if thing.shape == ROOM:
            return leaves
    return enters if 0 < enters < leaves else np.inf


@njit(cache=True)
def _through_slab(low, high, origin, direction):
    """Distances at which a ray enters and leaves the slab between two parallel planes."""
    if direction == 0:
        return (-np.inf, np.inf) if low <= origin <= high else (np.inf, -np.inf)
    to_low, to_high = (low - origin) / direction, (high - origin) / direction
    return min(to_low, to_high), max(to_low, to_high)


@njit(cache=True)
def _through_ellipsoid(low, high, axes, ray):
    """Distances at which a ray enters and leaves an ellipsoid, or with two axes an infinite upright cylinder."""
    square, middle, rest = 0.0, 0.0, -1.0
    for axis in range(axes):
        scale = 2.0 / (high[axis] - low[axis])
        offset, along = scale * (ray[0][axis] - 0.5 * (low[axis] + high[axis])), scale * ray[1][axis]
        square, middle, rest = square + along * along, middle - offset * along, rest + offset * offset
    discriminant = middle * middle - square * rest
    if square == 0:
        return (-np.inf, np.inf) if rest < 0 else (np.inf, -np.inf)
    if discriminant <= 0:
        return np.inf, -np.inf
    root = math.sqrt(discriminant)
    return (middle - root) / square, (middle + root) / square


@njit(cache=True)
def _silver_end(tables, origin, direction, end):
    """Normal and distance of the first silver hit closer than `end`; 0 and `end` without one."""
    normal = (0.0, 0.0, 0.0)
    for silver in tables.silver:
        low, high = vector(silver.low), vector(silver.high)
        distance, leaves = _through_ellipsoid(low, high, 3, (origin, direction))
        if SELF < distance < end and distance < leaves:
            end = distance
            normal = _round_normal(low, high, 3, moved(origin, distance, direction))
    return normal, end


@njit(cache=True)
def _next_pane(tables, origin, direction, between):
    """Index and distance of the first pane on a ray between two distances; the index is -1 without one."""
    nearest, found = between[1], -1
    for number in range(len(tables.panes)):
        pane = tables.panes[number]
        center, normal = vector(pane.center), vector(pane.normal)
        steepness = dot(direction, normal)
        if steepness == 0:
            continue
        distance = dot(minus(center, origin), normal) / steepness
        if between[0] < distance < nearest:
            offset = minus(moved(origin, distance, direction), center)
            across, up = abs(dot(offset, vector(pane.tangent))), abs(dot(offset, vector(pane.bitangent)))
            if across <= pane.half_sizes[0] and up <= pane.half_sizes[1]:
                nearest, found = distance, number
    return found, nearest


@njit(cache=True)
def _meeting(pane, which, ray):
    """Reflection of a ray at a pane or its second pane: the point, the reflected direction, and the reflected share.

    Multiple reflections between the two panes of double glazing are neglected.
    """
    origin, direction = ray
    center, normal = vector(pane.center), vector(pane.normal)
    share = reflectance(abs(dot(direction, normal)), pane.refraction)
    if pane.doubled and (dot(direction, normal) < 0) != (which == 0):
        share *= (1 - share) ** 2
    if which == 1:
        center, normal = vector(pane.second_center), vector(pane.second_normal)
    point = moved(origin, dot(minus(center, origin), normal) / dot(direction, normal), direction)
    return point, mirrored(direction, normal), share


@njit(cache=True)
def reflectance(cosine, refraction):
    """Reflectance of a pane for unpolarised light, by the cosine between ray and normal; 1 for mirrors.

    With Fresnel's r for each polarisation, multiple reflections between the two surfaces sum to 2 r / (1 + r).
    """
    if refraction == 0:
        return 1.0
    inside = math.sqrt(1 - (1 - cosine * cosine) / refraction**2)
    across = ((cosine - refraction * inside) / (cosine + refraction * inside)) ** 2
    along = ((inside - refraction * cosine) / (inside + refraction * cosine)) ** 2
    return across / (1 + across) + along / (1 + along)


@njit(cache=True)
def _shining(tables, thing, point):
    """Radiance of an object at a surface point: its paint under the light of the lamps."""
    inks, pattern = thing.inks, thing.pattern
    if pattern == GLOW:
        return inks[0, 0], inks[0, 1], inks[0, 2]
    local = _in_frame(thing.frame, point, 1.0) if thing.turned else point
    gain = tables.ambient
    if len(tables.lamps):
        gain += _lamplight(tables, point, _normal(thing, local))
    gain *= thing.shade
    place = moved((0.0, 0.0, 0.0), 1.0 / thing.scale, local)
    ink, dark = 0, 1.0
    if pattern == PATCHES:
        level = noise(thing.waves[0], place)
        ink = min(max(int(level * len(inks)), 0), len(inks) - 1)
        if _cell(place, CHECK) % 2 == 0 and noise(thing.waves[1], place) > 0.5:
            dark = 0.45
    elif pattern == STRIPES:
        ink = math.floor((place[0] + place[1] + 0.7 * place[2]) / STRIPE) % 2
    elif pattern == DOTS:
        ink = 1 if _from_dot(place) < DOT_RADIUS else 0
    shade = dark * (0.75 + 0.5 * noise(thing.waves[2], place))
    return (
        gain * min(max(inks[ink, 0] * shade, 0.01), 1.0),
        gain * min(max(inks[ink, 1] * shade, 0.01), 1.0),
        gain * min(max(inks[ink, 2] * shade, 0.01), 1.0),
    )


@njit(cache=True)
def _cell(place, side):
    """Sum of the integer coordinates of the grid cell of size `side` that contains a position."""
    return int(
        math.floor(place[0] / side + 0.5) + math.floor(place[1] / side + 0.5) + math.floor(place[2] / side + 0.5)
    )


@njit(cache=True)
def _from_dot(place):
    """Distance to the centre of the nearest dot, as a share of the spacing."""
    x, y, z = place[0] / DOT_SPACING, place[1] / DOT_SPACING, place[2] / DOT_SPACING
    x, y, z = x - np.rint(x), y - np.rint(y), z - np.rint(z)
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, fastmath=True)
def noise(waves, place):
    """A smooth random pattern in space, in about [0, 1]: `scene_surfaces.solid_noise`."""
    total = 0.0
    for wave in range(waves.shape[1]):
        cycles = place[0] * waves[0, wave] + place[1] * waves[1, wave] + place[2] * waves[2, wave] + waves[3, wave]
        cycles -= np.rint(cycles)
        x = cycles * cycles
        # Unrolled, so that the compiler vectorises over waves.
        total += (((((((C8 * x + C7) * x + C6) * x + C5) * x + C4) * x + C3) * x + C2) * x + C1) * x + C0
    return 0.5 + total / math.sqrt(8.0 * waves.shape[1])


@njit(cache=True)
def _lamplight(tables, point, normal):
    """Light of all lamps at a point, without shadows; diffuse shading is wrapped around the back."""
    light = 0.0
    for lamp in range(len(tables.lamps)):
        row = tables.lamps[lamp]
        towards = minus(vector(row.center), point)
        square = dot(towards, towards)
        facing = 0.5 + 0.5 * dot(towards, normal) / math.sqrt(max(square, 1e-12))
        light += row.power * facing / (1 + square / row.reach**2)
    return light


@njit(cache=True)
def _round_normal(low, high, axes, point):
    """Unit normal of the ellipsoid inscribed in a box, or with two axes of the upright cylinder."""
    x = (2 * point[0] - low[0] - high[0]) / (high[0] - low[0]) ** 2
    y = (2 * point[1] - low[1] - high[1]) / (high[1] - low[1]) ** 2
    z = (2 * point[2] - low[2] - high[2]) / (high[2] - low[2]) ** 2 if axes == 3 else 0.0
    return moved((0.0, 0.0, 0.0), 1 / math.sqrt(x * x + y * y + z * z), (x, y, z))


@njit(cache=True)
def _normal(thing, local):
    """Unit world normal at a point in the frame of an object, on its visible side."""
    low, high, shape = vector(thing.low), vector(thing.high), thing.shape
    x, y, z = (
        (2 * local[0] - low[0] - high[0]) / (high[0] - low[0]),
        (2 * local[1] - low[1] - high[1]) / (high[1] - low[1]),
        (2 * local[2] - low[2] - high[2]) / (high[2] - low[2]),
    )
    if shape == BALL:
        normal = _round_normal(low, high, 3, local)
    elif shape == CYLINDER and x * x + y * y > z * z:
        normal = _round_normal(low, high, 2, local)
    elif shape == CYLINDER or abs(z) >= max(abs(x), abs(y)):
        normal = 0.0, 0.0, math.copysign(1.0, z)
    elif abs(y) >= abs(x):
        normal = 0.0, math.copysign(1.0, y), 0.0
    else:
        normal = math.copysign(1.0, x), 0.0, 0.0
    if shape == ROOM:
        normal = -normal[0], -normal[1], -normal[2]
    if not thing.turned:
        return normal
    a, b, c = thing.frame[0], thing.frame[1], thing.frame[2]
    return moved(moved(moved((0.0, 0.0, 0.0), normal[0], vector(a)), normal[1], vector(b)), normal[2], vector(c))
