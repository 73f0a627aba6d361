"""What a mirror plane predicts of matches between photographs and mirror images of others.

A point X and its mirror image X' = X - 2 (n . X - d) n hold the plane n . x = d between them: its normal lies along
X - X', and half-way between them is a point of it. One pair of matched tracks is therefore a whole hypothesis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glassplat.suggest.matching import Observations, Pairs
from glassplat.suggest.tracks import Tracks

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

MOST_TURN = np.radians(35)
MOST_GROWTH = 1.8
"""Between a feature as the plane predicts it, with a patch that faces the camera, and as it is seen."""


@dataclass(frozen=True)
class Plane:
    """The points x with normal . x = offset; the normal is a unit vector."""

    normal: Array
    offset: float

    def heights(self, points: Array) -> Array:
        """[...] signed distances of points [..., 3]."""
        return np.asarray(points @ self.normal - self.offset)

    def mirrored(self, points: Array) -> Array:
        """[..., 3] their mirror images."""
        return np.asarray(points - 2 * self.heights(points)[..., None] * self.normal)


@dataclass(frozen=True)
class Prediction:
    """How some matches agree with a plane.

    Attributes:
        away: [N] pixels between the mirror image of the point and where it is seen.
        alike: [N] whether feature sizes and directions agree as well.
        by_mirror: [N] the camera that sees the mirror image is on the side of the thing itself, as mirrors have it.
        impossible: [N] neither of both is seen through the plane, which no mirror does, but whatever else is symmetric.
        both: [N] the thing itself is seen through the plane as well: beside the pane, or through it.
    """

    away: Array
    alike: NDArray[np.bool_]
    by_mirror: NDArray[np.bool_]
    impossible: NDArray[np.bool_]
    both: NDArray[np.bool_]


@dataclass(frozen=True)
class MirrorMatches:
    """Matches of an observation with the mirror image of a triangulated one, each in both roles.

    Attributes:
        seen: all observations.
        virtual: [N] the observation that would show a mirror image.
        real: [N] the one that would show the thing itself.
        track: [N] number of the point that `real` shows.
        points: [N, 3] that point.
        tips: [N, 3] a point beside it, as far as the feature's size, along its direction.
        virtual_points: [N, 3] the point that `virtual` shows, in space; NaN where it was not triangulated.
        virtual_track: [N] number of that, or -1.
        tracks: all points.
    """

    seen: Observations
    virtual: Numbers
    real: Numbers
    track: Numbers
    points: Array
    tips: Array
    virtual_points: Array
    virtual_track: Numbers
    tracks: Tracks

    @staticmethod
    def of(seen: Observations, tracks: Tracks, pairs: Pairs) -> MirrorMatches:
        """From pairs of observations [M, 2] that look like mirror images."""
        virtual, real = np.concatenate([pairs, pairs[:, ::-1]]).T
        known = (tracks.track[real] >= 0) & (tracks.track[virtual] != tracks.track[real])
        virtual, real = virtual[known], real[known]
        points = tracks.points[tracks.track[real]]
        others = np.concatenate([tracks.points, np.full((1, 3), np.nan)])  # The last one, -1, is none.
        return MirrorMatches(
            seen=seen,
            virtual=virtual,
            real=real,
            track=tracks.track[real],
            points=points,
            tips=_tips(seen, points, real),
            virtual_points=others[tracks.track[virtual]],
            virtual_track=tracks.track[virtual],
            tracks=tracks,
        )

    def __len__(self) -> int:
        return len(self.virtual)

    def seen_from_behind(self, plane: Plane) -> NDArray[np.bool_]:
        """[N] whether some camera behind a plane sees what would be a mirror image, which is there then."""
        shown = np.flatnonzero(self.tracks.track >= 0)
        track = self.tracks.track[shown]
        itself = plane.heights(self.tracks.points)[track] * plane.heights(self.seen.centers_of(shown)) > 0
        real = np.zeros(len(self.tracks.points) + 1, dtype=bool)  # The last one, -1, is none.
        real[track[itself]] = True
        return np.asarray(real[self.virtual_track])

    def predicted(self, planes: Plane, numbers: Numbers) -> Prediction:
        """What one plane says of some matches."""
        count = len(numbers)
        return self.predicted_by(
            np.broadcast_to(planes.normal, (count, 3)), np.full(count, planes.offset), numbers=numbers
        )

    def predicted_by(self, normals: Array, offsets: Array, *, numbers: Numbers) -> Prediction:
        """What planes [N] say of matches [N], each of its own."""
        seen, virtual = self.seen, self.virtual[numbers]
        pixels = seen.projected(_mirrored(self.points[numbers], normals, offsets), virtual)
        along = seen.projected(_mirrored(self.tips[numbers], normals, offsets), virtual) - pixels
        turn = np.arctan2(along[:, 1], along[:, 0]) - seen.turns[virtual]
        growth = np.log(np.maximum(np.hypot(*along.T), 1e-9) / seen.sizes[virtual])
        alike = (np.cos(turn) > np.cos(MOST_TURN)) & (np.abs(growth) < np.log(MOST_GROWTH))
        height = _heights(self.points[numbers], normals, offsets)
        through = height * _heights(seen.centers_of(virtual), normals, offsets) > 0
        other_through = height * _heights(seen.centers_of(self.real[numbers]), normals, offsets) < 0
        return Prediction(
            away=np.nan_to_num(np.hypot(*(pixels - seen.pixels[virtual]).T), nan=np.inf),
            alike=alike,
            by_mirror=through,
            impossible=~through & ~other_through,
            both=through & other_through,
        )


def _heights(points: Array, normals: Array, offsets: Array) -> Array:
    return np.asarray(np.einsum("nd,nd->n", points, normals) - offsets)


def _mirrored(points: Array, normals: Array, offsets: Array) -> Array:
    return np.asarray(points - 2 * _heights(points, normals, offsets)[:, None] * normals)


def _tips(seen: Observations, points: Array, numbers: Numbers) -> Array:
    """[N, 3] in a plane that faces the camera, through the points."""
    view = seen.view[numbers]
    turn, lens = seen.turns[numbers], seen.intrinsics[view]
    depth = np.einsum("nd,nd->n", seen.rotations[view][:, 2], points - seen.centers[view])
    step = (seen.sizes[numbers] * depth)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1) / lens[:, :2]
    return np.asarray(points + np.einsum("ni,nij->nj", step, seen.rotations[view][:, :2]))
