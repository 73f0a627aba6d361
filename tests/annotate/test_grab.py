"""GrabCut finds the object in a rough outline; without it, the page reports which package to install."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from glassplat.annotate.document import fill_polygon
from glassplat.annotate.results import grab_outlines
from glassplat.errors import InputError

HEIGHT, WIDTH = 160, 240
ROUGH = np.array([[60.0, 30], [170, 30], [170, 130], [60, 130]])


def hedge_before_a_wall() -> tuple[np.ndarray, np.ndarray]:
    """A photograph of a green disc in front of a grey wall, both mottled, and the mask of the disc."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    disc = np.hypot(x - 112, y - 78) < 36
    mottle = np.random.default_rng(0).normal(0, 12, (HEIGHT, WIDTH, 1))
    colors = np.where(disc[..., None], (40, 110, 50), (150, 150, 165)) + mottle
    return np.clip(colors, 0, 255).astype(np.uint8), disc


def covered(pieces: list[np.ndarray]) -> np.ndarray:
    masks = [fill_polygon(piece, (WIDTH, HEIGHT)) for piece in pieces]
    return np.any(masks, axis=0)


def test_the_object_is_found_within_a_rough_outline() -> None:
    photo, disc = hedge_before_a_wall()
    pieces = grab_outlines(photo, ROUGH)
    wrong = covered(pieces) != disc
    assert len(pieces) == 1 and wrong.sum() < 0.03 * disc.sum()
    np.testing.assert_array_equal(pieces[0], grab_outlines(photo, ROUGH)[0])


def test_large_photographs_give_the_same_outline() -> None:
    photo, disc = hedge_before_a_wall()
    large = np.kron(photo, np.ones((6, 6, 1), dtype=np.uint8))
    pieces = [piece / 6 for piece in grab_outlines(large, 6 * ROUGH)]
    assert (covered(pieces) != disc).sum() < 0.05 * disc.sum()


def test_an_outline_without_contrast_is_unchanged() -> None:
    photo = np.full((HEIGHT, WIDTH, 3), 120, dtype=np.uint8)
    everywhere = covered(grab_outlines(photo, ROUGH))
    assert (everywhere & ~fill_polygon(ROUGH, (WIDTH, HEIGHT))).sum() == 0 and everywhere.any()


def test_an_outline_that_leaves_the_photograph_is_cut_there() -> None:
    photo, disc = hedge_before_a_wall()
    pieces = grab_outlines(photo[:, 90:], ROUGH - np.array([90, 0]))
    found = covered([piece + np.array([90, 0]) for piece in pieces])
    assert (found[:, 91:] != disc[:, 91:]).sum() < 0.05 * disc.sum()


def test_an_outline_without_surroundings_stays() -> None:
    photo, _ = hedge_before_a_wall()
    around = np.array([[-5.0, -5], [WIDTH + 5, -5], [WIDTH + 5, HEIGHT + 5], [-5, HEIGHT + 5]])
    (outline,) = grab_outlines(photo, around)
    np.testing.assert_array_equal(outline, around)


def test_an_outline_outside_the_photograph_is_refused() -> None:
    photo, _ = hedge_before_a_wall()
    with pytest.raises(InputError, match="lies outside the photograph"):
        grab_outlines(photo, ROUGH + np.array([1000, 0]))


def test_a_missing_opencv_is_reported_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"pip install 'glassplat\[video\]'"):
        grab_outlines(hedge_before_a_wall()[0], ROUGH)
