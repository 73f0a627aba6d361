"""The viewer's benchmark measures the images that are displayed."""

from __future__ import annotations

from benchmarks.looking import WIDTH, answers, looking_times
from glassplat.viewer.render_loop import LEAST_WIDTH


def test_every_move_gets_a_first_and_a_full_picture() -> None:
    for moving in (False, True):
        for answer in answers(3, 500, moving=moving):
            assert 0 < answer.first <= answer.full and LEAST_WIDTH <= answer.width <= WIDTH


def test_the_table_lists_moves_from_rest_and_while_drawing() -> None:
    table = looking_times(moves=2, count=300).markdown()
    assert "moves from rest" in table and "while a full picture is drawn" in table
