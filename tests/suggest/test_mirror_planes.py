"""Planes are found from matches with mirror images; symmetric things and chance are not."""

from __future__ import annotations

import numpy as np
import pytest

from glassplat.suggest.mirror_matches import MirrorMatches, Plane
from glassplat.suggest.mirror_planes import judged, mirror_planes
from tests.suggest.mirror_room import EXTENT, Room, degrees_between, eyes_around, things

WALL = Plane(np.array([0.0, 1.0, 0.0]), 0.0)
SIDE = Plane(np.array([1.0, 0.0, 0.0]), 2.2)


def room(seed: int, *, side: float = 1.0) -> tuple[Room, np.random.Generator]:
    rng = np.random.default_rng(seed)
    eyes = eyes_around(rng, 14, (0.0, 0.0, 0.0), side=side) + eyes_around(rng, 10, (0.0, 3.0, 0.0), side=side)
    return Room(eyes, rng), rng


@pytest.mark.parametrize("seed", range(3))
def test_a_mirror_is_found_among_five_times_as_many_wrong_matches(seed: int) -> None:
    place, rng = room(seed)
    place.add_mirrored([WALL], *things(rng, 120))
    place.add_outliers(5 * len(place.mirrored))
    (found,) = mirror_planes(place.matches(), EXTENT)
    assert degrees_between(found.plane.normal, WALL.normal) < 0.3
    assert abs(found.plane.heights(np.zeros(3))) < 0.01
    assert found.impossible <= 2


def test_two_mirrors_are_found() -> None:
    rng = np.random.default_rng(4)
    eyes = [
        *eyes_around(rng, 12, (0.0, 0.0, 0.0)),
        *eyes_around(rng, 12, (2.2, 1.5, 0.0)),
        *eyes_around(rng, 10, (0.0, 3.0, 0.0)),
        *eyes_around(rng, 10, (-2.0, 1.5, 0.0)),
    ]
    place = Room(eyes, rng)
    place.add_mirrored([WALL, SIDE], *things(rng, 150))
    place.add_outliers(2 * len(place.mirrored))
    found = mirror_planes(place.matches(), EXTENT)
    assert len(found) == 2
    for plane in (WALL, SIDE):
        assert min(degrees_between(one.plane.normal, plane.normal) for one in found) < 0.5


def test_chance_is_no_pane() -> None:
    place, rng = room(5)
    place.add_mirrored([], *things(rng, 150))
    place.add_outliers(5000)
    assert mirror_planes(place.matches(), EXTENT) == []


def test_a_symmetric_thing_that_is_seen_from_both_sides_is_no_pane() -> None:
    place, rng = room(6, side=0)
    place.add_symmetric(WALL, *things(rng, 150))
    matches = place.matches()
    told = judged(WALL, matches, EXTENT)
    assert told.impossible > 15, "the plane explains the matches, but not as a mirror would"
    assert mirror_planes(matches, EXTENT) == []


def test_a_thing_that_is_seen_from_behind_is_no_mirror_image() -> None:
    place, rng = room(6, side=0)
    place.add_symmetric(WALL, *things(rng, 150))
    before = [eye.center[1] > 0 for eye in place.eyes]
    place.mirrored = [pair for pair in place.mirrored if all(before[place.rows[one][0]] for one in pair)]
    matches = place.matches()
    agreeing = matches.predicted(WALL, np.arange(len(matches)))
    assert not agreeing.impossible.any(), "match by match it could be a mirror"
    told = judged(WALL, matches, EXTENT)
    assert told.places < 5 and told.impossible > 15
    assert mirror_planes(matches, EXTENT) == []


@pytest.mark.parametrize("seed", range(3))
def test_a_pane_is_found_that_photographs_look_through_from_behind(seed: int) -> None:
    place, rng = room(seed, side=0)
    place.add_mirrored([WALL], *things(rng, 150))
    place.add_outliers(len(place.mirrored))
    matches = place.matches()
    assert matches.predicted(WALL, np.arange(len(matches))).both.sum() > 100
    (found,) = mirror_planes(matches, EXTENT)
    assert degrees_between(found.plane.normal, WALL.normal) < 0.3
    assert found.impossible <= 2


def test_without_matches_there_is_nothing() -> None:
    place, rng = room(7)
    place.add_mirrored([], *things(rng, 20))
    assert mirror_planes(place.matches(), EXTENT) == []


def test_features_that_are_turned_otherwise_do_not_agree() -> None:
    place, rng = room(8)
    place.add_mirrored([WALL], *things(rng, 40))
    right = place.matches()
    place.rows = [(view, pixel, size, turn + np.pi / 2) for view, pixel, size, turn in place.rows]
    wrong = place.matches()
    # A quarter turn of what is mirrored is one the other way round: half a turn is between them.
    everything = [matches.predicted(WALL, np.arange(len(matches))) for matches in (right, wrong)]
    assert everything[0].alike.mean() > 0.5
    assert everything[1].alike.mean() < 0.15


@pytest.mark.parametrize("seed", range(5))
def test_mirroring_twice_is_the_identity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    plane = Plane(normal / np.linalg.norm(normal), float(rng.normal()))
    points = rng.normal(size=(50, 3))
    assert np.allclose(plane.mirrored(plane.mirrored(points)), points)
    assert np.allclose(plane.heights((points + plane.mirrored(points)) / 2), 0, atol=1e-12)


def test_true_matches_agree_with_their_plane_and_see_through_it() -> None:
    place, rng = room(9)
    place.add_mirrored([WALL], *things(rng, 60))
    matches: MirrorMatches = place.matches()
    told = matches.predicted(WALL, np.arange(len(matches)))
    behind = matches.points[:, 1] < 0  # The roles exchanged: the mirror image taken for the thing.
    assert not told.impossible.any()
    assert told.by_mirror[~behind].all()
    assert not told.by_mirror[behind].any()
    assert np.median(told.away[~behind]) < 2.0
