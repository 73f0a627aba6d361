"""A few photographs are all compared; of many, neighbours and similar ones."""

from __future__ import annotations

import numpy as np

from glassplat.prepare.colmap import MOST_EXHAUSTIVE, all_pairs, neighbouring_pairs, pairs_to_match, similar_pairs


def walk_round(count: int, *, places: int = 30) -> list[np.ndarray]:
    """Descriptors along a walk that returns to its start: each position has its own features."""
    rng = np.random.default_rng(0)
    features = rng.integers(0, 120, (count, places, 128))
    shown = [np.concatenate([features[(k + step) % count] for step in range(3)]) for k in range(count)]
    return [np.clip(one + rng.integers(-3, 4, one.shape), 0, 255).astype(np.uint8) for one in shown]


def test_all_pairs_are_each_once() -> None:
    pairs = all_pairs(5)
    assert len(pairs) == len({frozenset(pair) for pair in pairs}) == 10


def test_few_photographs_are_all_compared() -> None:
    assert len(pairs_to_match([np.zeros((0, 128), np.uint8)] * MOST_EXHAUSTIVE)) == MOST_EXHAUSTIVE * 79 // 2


def test_loops_are_closed_by_similar_photographs() -> None:
    count = 100
    descriptors = walk_round(count)
    pairs = set(pairs_to_match(descriptors))
    assert set(neighbouring_pairs(count)) <= pairs
    assert (count - 1, 0) in pairs and (count - 1, 0) not in neighbouring_pairs(count)
    assert len(pairs) < count * (count - 1) / 4
    assert all(one > other for one, other in pairs)


def test_similar_pairs_include_all_neighbours_on_a_loop() -> None:
    found = {frozenset(pair) for pair in similar_pairs(walk_round(60))}
    assert all(frozenset((k, (k + 1) % 60)) in found for k in range(60))


def test_photographs_without_features_are_no_obstacle() -> None:
    descriptors = [*walk_round(90), np.zeros((0, 128), np.uint8)]
    assert pairs_to_match(descriptors) == pairs_to_match(descriptors)
