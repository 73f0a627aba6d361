"""Estimated normals for synthetic scenes have the requested smooth errors, and are stored in the file that is read."""

from __future__ import annotations

import numpy as np
import pytest

from tools.estimated_normals import estimated_normals, rotated, smooth_turns

SIZE = 96


def hemisphere() -> tuple[np.ndarray, np.ndarray]:
    """Normals [S, S, 3] of a ball that fills the image, and its mask [S, S]."""
    y, x = np.meshgrid(*[(np.arange(SIZE) + 0.5) / SIZE * 2 - 1] * 2, indexing="ij")
    inside = x**2 + y**2 < 0.9
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    return np.stack([x, -y, z], axis=-1) * inside[..., None], inside.astype(float)


def degrees_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))


def test_turns_keep_lengths_and_turn_by_their_own() -> None:
    random = np.random.default_rng(0)
    vectors, turns = random.standard_normal((2, 50, 3))
    np.testing.assert_allclose(np.linalg.norm(rotated(vectors, turns), axis=-1), np.linalg.norm(vectors, axis=-1))
    quarter = rotated(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(quarter, [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("error", [2.0, 10.0, 20.0])
def test_estimated_normals_have_the_requested_error(error: float) -> None:
    normals, coverage = hemisphere()
    off = []
    for seed in range(20):
        estimate = estimated_normals(normals, coverage, error, np.random.default_rng(seed))
        off.append(degrees_between(estimate, normals)[coverage > 0].mean())
        assert not estimate[coverage == 0].any()
        np.testing.assert_allclose(np.linalg.norm(estimate, axis=-1)[coverage > 0], 1)
    assert np.mean(off) == pytest.approx(error, rel=0.15)


def test_the_error_is_smooth_and_differs_from_photograph_to_photograph() -> None:
    turns = smooth_turns(SIZE, 0.2, np.random.default_rng(1))
    assert np.abs(np.diff(turns, axis=0)).max() < 0.1 * np.abs(turns).max()
    assert not np.allclose(turns, smooth_turns(SIZE, 0.2, np.random.default_rng(2)))
