"""Places drawn by chance are the same for the same seed, and can be photographed."""

from __future__ import annotations

import numpy as np
import pytest

from tools.make_pane_scene import see
from tools.pane_draws import CLEARANCE, draw_place, is_clear
from tools.pane_tracer import Lamp

SEEDS = range(20, 23)
VIEWS = 24


def test_a_seed_draws_the_same_place_every_time_and_another_one_does_not() -> None:
    first, again, other = draw_place(7, VIEWS), draw_place(7, VIEWS), draw_place(8, VIEWS)
    np.testing.assert_array_equal(np.stack(first.poses), np.stack(again.poses))
    assert first.place.lamp == again.place.lamp != other.place.lamp
    np.testing.assert_array_equal(first.place.panes[0].center, again.place.panes[0].center)
    assert not np.array_equal(first.place.panes[0].center, other.place.panes[0].center)


@pytest.mark.parametrize("seed", SEEDS)
def test_cameras_stand_clear_of_everything_and_see_every_pane(seed: int) -> None:
    drawn = draw_place(seed, VIEWS)
    assert all(is_clear(drawn.place, pose[:3, 3]) for pose in drawn.poses)
    labels = np.stack([see(drawn.place, pose, 16, 12).label for pose in drawn.poses])
    for pane in drawn.place.panes:
        assert (labels == pane.label).any(axis=(1, 2, 3)).sum() >= 3


def test_nothing_is_clear_inside_of_a_thing_or_beside_a_pane() -> None:
    place = draw_place(7, 1).place
    pane = place.panes[0]
    assert not is_clear(place, pane.center + 0.5 * CLEARANCE * pane.normal)
    for thing in place.things[1:]:
        middle = np.array(thing.center if hasattr(thing, "center") else np.add(thing.low, thing.high) / 2)
        assert not is_clear(place, middle)


def test_a_lamp_lights_half_as_much_at_its_reach() -> None:
    lamp = Lamp((1.0, 0.0, 0.0), reach=0.5)
    assert lamp.gains(np.array([[1.0, 0, 0], [1.5, 0, 0], [1.0, 0, 1.0]])) == pytest.approx(
        np.array([[2.0], [1], [0.4]])
    )
