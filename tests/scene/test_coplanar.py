"""Panes of one glass front are recognised as lying in one plane."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from glassplat.scene.panes import Planes, coplanar_groups, name_labels


def at(x: float, offset: float = 0.0, turn_deg: float = 0.0, half: float = 0.5, label: int = 1) -> Planes:
    """A pane in the plane z = 0, or displaced by an offset and a rotation about the vertical axis."""
    turn = math.radians(turn_deg)
    return Planes.rectangle((x, 0.0, offset), (math.sin(turn), 0.0, math.cos(turn)), (half, 1.0), label=label)


def front(*panes: Planes) -> Planes:
    tensors = {name: torch.cat([pane.tensors()[name] for pane in panes]) for name in panes[0].tensors()}
    return Planes(**tensors, labels=tuple(range(1, len(panes) + 1)))


def test_panes_between_posts_are_one_group_the_largest_first() -> None:
    planes = front(at(0.0), at(1.1, half=0.6), at(0.0, offset=0.5), at(2.3))
    assert coplanar_groups(planes, range(4)) == [[1, 0, 3], [2]]
    assert coplanar_groups(planes, [0, 2]) == [[0], [2]]
    assert coplanar_groups(planes, []) == []


def test_rotated_and_overlapping_panes_have_separate_planes() -> None:
    assert coplanar_groups(front(at(0.0), at(1.0, turn_deg=3)), range(2)) == [[0], [1]]
    assert coplanar_groups(front(at(0.0), at(0.0, offset=0.05)), range(2)) == [[0], [1]]
    assert coplanar_groups(front(at(0.0), at(1.0, turn_deg=0.5)), range(2)) == [[0, 1]]
    # The second centre lies in the plane of the first pane, but not the first centre in the plane of the second.
    assert coplanar_groups(front(at(0.0), at(4.0, turn_deg=0.9)), range(2)) == [[0], [1]]


@pytest.mark.parametrize("unit", [0.1, 20.0])
def test_the_unit_of_length_does_not_matter(unit: float) -> None:
    for panes, expected in (
        ((at(0.0), at(0.0, offset=0.015)), [[0, 1]]),
        ((at(0.0), at(0.0, offset=0.025)), [[0], [1]]),
    ):
        planes = front(*panes)
        scaled = replace(planes, centers=unit * planes.centers, half_sizes=unit * planes.half_sizes)
        assert coplanar_groups(scaled, range(2)) == expected


def test_the_marked_side_of_a_pane_does_not_matter() -> None:
    assert coplanar_groups(front(at(0.0), at(1.0, turn_deg=180)), range(2)) == [[0, 1]]


def test_a_third_pane_joins_two_that_are_too_far_apart_for_their_angle() -> None:
    planes = front(at(0.0), at(2.0, offset=0.03, turn_deg=0.0), at(1.0, offset=0.015))
    assert coplanar_groups(planes, [0, 1]) == [[0], [1]]
    assert coplanar_groups(planes, range(3)) == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("labels", "named"), [((), ""), ((4,), "4"), ((3, 1, 2), "1, 2, 3"), ((2, 3, 4, 5, 9, 8, 1), "1 to 5, 8, 9")]
)
def test_labels_that_follow_each_other_are_named_together(labels: tuple[int, ...], named: str) -> None:
    assert name_labels(labels) == named
