"""Which features of two photographs show the same place, directly or as each other's mirror image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from glassplat.scene.eye import Eye
from glassplat.suggest.features import Descriptors, Features, mirrored

Array = NDArray[np.float64]
Pairs = NDArray[np.int64]

MOST_RATIO = 0.85
"""Of the distance to the nearest descriptor, to that to the second (Lowe 2004, Section 7.1)."""
MOST_CHIRAL_RATIO = 0.9
"""Of the distance to a mirror image, to what the feature is unlike as it is: what is symmetric tells nothing."""
MOST_OFF = 0.004
"""From an epipolar line, in image diagonals."""


@dataclass(frozen=True)
class Observations:
    """All features of all views, one after the other.

    Attributes:
        view: [O] number of the view.
        pixels: [O, 2].
        sizes: [O] pixels.
        turns: [O] radians.
        rays: [O, 3] unit directions in the world.
        eyes: the views' cameras.
    """

    view: NDArray[np.int64]
    pixels: Array
    sizes: Array
    turns: Array
    rays: Array
    eyes: Sequence[Eye]

    @staticmethod
    def of(features: Sequence[Features], eyes: Sequence[Eye]) -> Observations:
        """Those of some views."""
        return Observations(
            view=np.repeat(np.arange(len(features)), [len(one) for one in features]),
            pixels=np.concatenate([one.pixels for one in features]),
            sizes=np.concatenate([one.sizes for one in features]),
            turns=np.concatenate([one.turns for one in features]),
            rays=np.concatenate([eye.rays(one.pixels) for eye, one in zip(eyes, features, strict=True)]),
            eyes=eyes,
        )

    @cached_property
    def centers(self) -> Array:
        """[V, 3] of the cameras."""
        return np.stack([eye.center for eye in self.eyes])

    @cached_property
    def rotations(self) -> Array:
        """[V, 3, 3] of `cam_from_world`."""
        return np.stack([eye.rotation for eye in self.eyes])

    @cached_property
    def intrinsics(self) -> Array:
        """[V, 4] fx, fy, cx, cy in pixels."""
        return np.stack([eye.intrinsics for eye in self.eyes])

    def centers_of(self, numbers: NDArray[np.int64]) -> Array:
        """[N, 3] of the cameras of some observations."""
        return np.asarray(self.centers[self.view[numbers]])

    def projected(self, points: Array, numbers: NDArray[np.int64]) -> Array:
        """[N, 2] pixels of points [N, 3], each in the view of one observation; NaN behind the camera."""
        view = self.view[numbers]
        in_camera = np.einsum("nij,nj->ni", self.rotations[view], points - self.centers[view])
        depth = np.where(in_camera[:, 2] > 0, in_camera[:, 2], np.nan)
        lens = self.intrinsics[view]
        return np.asarray(lens[:, :2] * in_camera[:, :2] / depth[:, None] + lens[:, 2:])

    def distances(self, points: Array, numbers: NDArray[np.int64]) -> Array:
        """[N] pixels between observations and the projections of points [N, 3]; infinite behind the camera."""
        away = np.hypot(*(self.projected(points, numbers) - self.pixels[numbers]).T)
        return np.nan_to_num(away, nan=np.inf)

    @cached_property
    def diagonal(self) -> float:
        """Of the middle photograph, in pixels."""
        return float(np.median([eye.diagonal for eye in self.eyes]))


@dataclass(frozen=True)
class Matches:
    """Pairs of observations, by number.

    Attributes:
        direct: [D, 2] that show the same place, as far as the poses allow it.
        mirrored: [M, 2] that look like each other's mirror image.
    """

    direct: Pairs
    mirrored: Pairs


def matched(features: Sequence[Features], seen: Observations, listen: Callable[[int, int], None]) -> Matches:
    """Compares every photograph with every other, and with the mirror image of every one, its own too.

    Args:
        features: of each view.
        seen: the same, one after the other.
        listen: is told how many views of how many are compared.
    """
    first = np.cumsum([0, *map(len, features)])
    flipped = [mirrored(one.descriptors) for one in features]
    direct, mirror = [np.zeros((0, 2), dtype=np.int64)], [np.zeros((0, 2), dtype=np.int64)]
    for one, feature in enumerate(features):
        listen(one, len(features))
        for other in range(one + 1):
            shift = np.array([first[one], first[other]])
            target = features[other].descriptors
            if other < one:
                pairs = nearest_pairs(feature.descriptors, target) + shift
                direct.append(pairs[along_epipolar_lines(seen, pairs)])
            pairs = nearest_pairs(flipped[one], target)
            mirror.append(pairs[_is_chiral(feature.descriptors, flipped[one], target, pairs)] + shift)
    return Matches(np.concatenate(direct), np.concatenate(mirror))


def nearest_pairs(one: Descriptors, other: Descriptors) -> Pairs:
    """[P, 2] descriptors that are each other's nearest, and much nearer than the second nearest."""
    if len(one) < 2 or len(other) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    likeness = one @ other.T
    rows = np.arange(len(one))
    nearest, back = likeness.argmax(axis=1), likeness.argmax(axis=0)
    best = likeness[rows, nearest]
    likeness[rows, nearest] = -1.0
    second = likeness.max(axis=1)
    # Of unit vectors the squared distance is 2 - 2 cos.
    chosen = (back[nearest] == rows) & (1 - best < MOST_RATIO**2 * (1 - second))
    return np.stack([rows[chosen], nearest[chosen]], axis=1)


def along_epipolar_lines(seen: Observations, pairs: Pairs) -> NDArray[np.bool_]:
    """[P] which pairs the poses allow to be one place."""
    close = np.ones(len(pairs), dtype=bool)
    between = seen.centers[seen.view[pairs[:, 1]]] - seen.centers[seen.view[pairs[:, 0]]]
    for here, there in ((0, 1), (1, 0)):
        normal = np.cross(seen.rays[pairs[:, here]], between)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        sine = np.abs((normal * seen.rays[pairs[:, there]]).sum(axis=1))
        focal = seen.intrinsics[seen.view[pairs[:, there]], 0]
        close &= sine * focal < MOST_OFF * seen.diagonal
    return close


def _is_chiral(one: Descriptors, flipped: Descriptors, other: Descriptors, pairs: Pairs) -> NDArray[np.bool_]:
    """[P] which features differ from what they are matched with, and from their own mirror image."""
    here, mirror, there = one[pairs[:, 0]], flipped[pairs[:, 0]], other[pairs[:, 1]]
    away = 1 - (mirror * there).sum(axis=1)
    unlike = np.minimum(1 - (here * there).sum(axis=1), 1 - (mirror * here).sum(axis=1))
    return np.asarray(away < MOST_CHIRAL_RATIO**2 * unlike)
