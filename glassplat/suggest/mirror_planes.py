"""Planes in which photographs show what others show directly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glassplat.suggest.mirror_matches import MirrorMatches, Plane
from glassplat.suggest.pane_extent import seen_within

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

ROUGH, FINE = 0.01, 0.0035
"""Distances, in image diagonals, within which a match agrees with a guessed plane, and with a fitted one."""
LEAST_HEIGHT = 0.015
"""Of a point above its mirror plane, in extents, to tell the plane's direction."""
VOTE_REACH = 0.12
"""Between mirror images of fixed points, in extents, of planes that vote for each other."""
SAME_PLANE = 0.2
MOST_TRIED = 40
PLACE = 0.03
"""In extents: points in one cube of this size count once, since one thing may be in several tracks."""
LEAST_PLACES = 15
MOST_IMPOSSIBLE = 0.2
"""Of places whose matches agree with the plane, but as no mirror has them, for each one as a mirror has it."""


@dataclass(frozen=True)
class MirrorPlane:
    """A plane with what speaks for it.

    Attributes:
        plane: the plane.
        places: how many different things are seen in it, and directly too.
        impossible: how many more agree with it, but in a way that no mirror has.
        matches: numbers of the matches that agree as a mirror has it.
    """

    plane: Plane
    places: int
    impossible: int
    matches: Numbers

    @property
    def is_mirror(self) -> bool:
        """Whether enough speaks for it, and little against."""
        return self.places >= LEAST_PLACES and self.impossible <= MOST_IMPOSSIBLE * self.places


def mirror_planes(matches: MirrorMatches, extent: float) -> list[MirrorPlane]:
    """The planes that explain matches as mirror images; the best supported first.

    Every pair of matched tracks is a plane. Those that its own match confirms vote for each other; the ones with the
    most votes are fitted to all matches, and kept where these agree as a mirror has it. What is seen within a pane that
    was found speaks for no other one: things that repeat themselves would make copies of it.

    Args:
        matches: photographs against mirror images of others.
        extent: of the cameras, world units.
    """
    likely = []
    for plane in _voted(*_hypotheses(matches, extent), matches=matches, extent=extent):
        if judged(plane, matches, extent, ROUGH).places >= LEAST_PLACES / 2:
            likely.append(judged(refined(plane, matches, extent), matches, extent))
    found: list[MirrorPlane] = []
    free = np.ones(len(matches), dtype=bool)
    for one in sorted(likely, key=lambda one: -one.places):
        left = _without(one, free, matches, extent)
        known = any(_distance(left.plane, other.plane, matches, extent) < SAME_PLANE for other in found)
        if left.is_mirror and not known:
            found.append(left)
            for role in (matches.virtual, matches.real):
                free &= ~seen_within(left.plane, matches.seen, matches.virtual[left.matches], role)
    return found


def _without(one: MirrorPlane, free: NDArray[np.bool_], matches: MirrorMatches, extent: float) -> MirrorPlane:
    """What is left for a plane when only some matches count."""
    kept = one.matches[free[one.matches]]
    return MirrorPlane(one.plane, _places(matches, kept, extent), one.impossible, kept)


def judged(plane: Plane, matches: MirrorMatches, extent: float, reach: float = FINE) -> MirrorPlane:
    """What speaks for and against a plane: matches that agree with it to within `reach` image diagonals.

    What is seen through the plane from both sides says nothing: a case of glass shows the room behind it as well.
    """
    told = matches.predicted(plane, np.arange(len(matches)))
    agreeing = (told.away < reach * matches.seen.diagonal) & told.alike
    mirrored, really_there = told.by_mirror & ~told.both, matches.seen_from_behind(plane)
    shown = np.flatnonzero(agreeing & mirrored & ~really_there)
    against = np.flatnonzero(agreeing & (told.impossible | mirrored & really_there))
    return MirrorPlane(plane, _places(matches, shown, extent), _places(matches, against, extent), shown)


def refined(plane: Plane, matches: MirrorMatches, extent: float) -> Plane:
    """The plane that brings mirror images closest to where they are seen."""
    everything = np.arange(len(matches))
    for reach in (1.5 * ROUGH, ROUGH, 2 * FINE, FINE):
        told = matches.predicted(plane, everything)
        chosen = np.flatnonzero((told.away < reach * matches.seen.diagonal) & told.alike & told.by_mirror)
        if len(chosen) < 4:
            return plane
        plane = _fitted(plane, matches, chosen, extent)
    return plane


def _fitted(plane: Plane, matches: MirrorMatches, chosen: Numbers, extent: float) -> Plane:
    """Least squares over some matches, every point with the same weight however often it is matched."""
    from scipy.optimize import least_squares  # Slow to import, and `annotate` needs it with --suggest alone.

    points, virtual = matches.points[chosen], matches.virtual[chosen]
    _, track = np.unique(matches.track[chosen], return_inverse=True)
    weight = 1 / np.sqrt(np.bincount(track)[track])[:, None]
    axes = np.linalg.svd(plane.normal[None])[2][1:]
    pivot = points.mean(axis=0) - plane.heights(points.mean(axis=0)) * plane.normal

    def stepped(step: Array) -> Plane:
        normal = plane.normal + step[:2] @ axes
        normal /= np.linalg.norm(normal)
        return Plane(normal, float(normal @ pivot) + step[2] * extent)

    def residuals(step: Array) -> Array:
        pixels = matches.seen.projected(stepped(step).mirrored(points), virtual)
        away = np.clip(np.nan_to_num(pixels - matches.seen.pixels[virtual], nan=1e3), -1e3, 1e3)
        return np.asarray((weight * away).ravel())

    scale = FINE / 2 * matches.seen.diagonal
    return stepped(least_squares(residuals, np.zeros(3), loss="soft_l1", f_scale=scale, max_nfev=30).x)


def _hypotheses(matches: MirrorMatches, extent: float) -> tuple[Array, Array]:
    """Normals [H, 3] and offsets [H] of the planes of pairs of tracks that their own matches confirm."""
    pair = np.flatnonzero(matches.virtual_track >= 0)
    apart = matches.points[pair] - matches.virtual_points[pair]
    far = np.linalg.norm(apart, axis=1) > 2 * LEAST_HEIGHT * extent
    pair, apart = pair[far], apart[far]
    normals = apart / np.linalg.norm(apart, axis=1, keepdims=True)
    offsets = np.einsum("nd,nd->n", normals, matches.points[pair] + matches.virtual_points[pair]) / 2
    told = matches.predicted_by(normals, offsets, numbers=pair)
    good = (told.away < ROUGH * matches.seen.diagonal) & told.alike & told.by_mirror
    tracks = np.stack([matches.track[pair], matches.virtual_track[pair]], axis=1)[good]
    _, first = np.unique(tracks, axis=0, return_index=True)
    return normals[good][first], offsets[good][first]


def _voted(normals: Array, offsets: Array, *, matches: MirrorMatches, extent: float) -> Iterator[Plane]:
    """Different planes among many, those with most others close to them first."""
    from scipy.spatial import cKDTree

    if not len(offsets):
        return
    images = np.stack([_images(n, d, matches, extent) for n, d in zip(normals, offsets, strict=True)])
    votes = cKDTree(images).query_ball_point(images, VOTE_REACH, return_length=True)
    open_ones = np.ones(len(votes), dtype=bool)
    for _ in range(MOST_TRIED):
        best = int(np.argmax(np.where(open_ones, votes, -1)))
        if not open_ones[best]:
            return
        open_ones &= np.linalg.norm(images - images[best], axis=1) > VOTE_REACH
        yield Plane(normals[best], float(offsets[best]))


def _images(normal: Array, offset: float, matches: MirrorMatches, extent: float) -> Array:
    """[12] mirror images of four fixed points, in extents; they differ as much as what the planes mirror."""
    center = np.median(matches.seen.centers, axis=0)
    fixed = center + extent * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    return Plane(normal, offset).mirrored(fixed).ravel() / extent


def _distance(one: Plane, other: Plane, matches: MirrorMatches, extent: float) -> float:
    images = [_images(plane.normal, plane.offset, matches, extent) for plane in (one, other)]
    return float(np.linalg.norm(images[0] - images[1]))


def _places(matches: MirrorMatches, chosen: Numbers, extent: float) -> int:
    """How many places the points of some matches are in."""
    points = matches.points[chosen]
    return len(np.unique(np.floor(points / (PLACE * extent)).astype(np.int64), axis=0))
