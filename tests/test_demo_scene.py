"""The bundled demo scene is complete, small and physically consistent."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import glassplat

SCENE = Path(glassplat.__file__).parent / "demo_scene"
TEST_NAMES = sorted(path.stem for path in (SCENE / "images").iterdir())[::8]


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def linear_from_srgb(srgb: np.ndarray) -> np.ndarray:
    unit = srgb / 255.0
    return np.where(unit <= 0.04045, unit / 12.92, ((unit + 0.055) / 1.055) ** 2.4)


def test_it_is_small_enough_to_ship() -> None:
    assert sum(path.stat().st_size for path in SCENE.rglob("*") if path.is_file()) < 8_000_000


def test_every_picture_has_the_size_of_the_camera() -> None:
    _, model, width, height, *_ = (SCENE / "sparse/0/cameras.txt").read_text().split()
    assert model == "PINHOLE"
    pictures = [path for path in SCENE.rglob("*") if path.suffix in (".jpg", ".png")]
    assert len(pictures) == 64 + 8 + 4 * len(TEST_NAMES)
    assert {pixels(path).shape[:2] for path in pictures} == {(int(height), int(width))}


def test_the_model_names_every_photograph() -> None:
    lines = (SCENE / "sparse/0/images.txt").read_text().splitlines()
    named = {line.split()[9] for line in lines[::2]}
    assert named == {path.name for path in (SCENE / "images").iterdir()}


def test_the_truth_covers_exactly_the_test_views_and_the_masks_only_training_views() -> None:
    for layer in ("trans", "refl"):
        assert sorted(path.stem for path in (SCENE / "gt" / layer).iterdir()) == TEST_NAMES
    strengths = {path.stem for path in (SCENE / "gt/strength").iterdir()}
    assert strengths == set(TEST_NAMES) | {f"{name}_pane" for name in TEST_NAMES}
    masks = {path.stem for path in (SCENE / "panes").iterdir()}
    assert masks.isdisjoint(TEST_NAMES)
    assert json.loads((SCENE / "gt/planes.json").read_text())[0]["label"] == 1


def blocks(picture: np.ndarray) -> np.ndarray:
    """Mean of each block of 4x4 pixels, which cancels JPEG errors."""
    height, width = (side // 4 for side in picture.shape[:2])
    return picture.reshape(height, 4, width, 4, -1).mean(axis=(1, 3))


@pytest.mark.parametrize("name", TEST_NAMES)
def test_the_layers_add_up_to_the_photograph(name: str) -> None:
    pane = blocks(pixels(SCENE / f"gt/strength/{name}_pane.png"))[..., 0] == 1
    photograph, transmission, reflection = (
        blocks(linear_from_srgb(pixels(path)))
        for path in (
            SCENE / f"images/{name}.jpg",
            SCENE / f"gt/trans/{name}.jpg",
            SCENE / f"gt/refl/{name}.jpg",
        )
    )
    strength = blocks(pixels(SCENE / f"gt/strength/{name}.png")) / 65535.0
    composed = (1 - strength) * transmission + strength * reflection
    # Images contain nothing brighter than white.
    exposed = pane & (reflection.max(axis=-1) < 0.9) & (transmission.max(axis=-1) < 0.9)
    # Views that look away from the pane have nothing to compare.
    assert exposed.any() or not pane.any()
    difference = np.abs(composed - photograph)[exposed]
    assert difference.size == 0 or difference.mean() < 0.005
