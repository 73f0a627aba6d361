"""Training on captures with masks: black pixels are ignored as usual in the field, and panes are found as before."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from glassplat.captures.dataset import Dataset, load_dataset
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model.training import Training
from tests.training.tiny_capture import write_tiny_capture

KEPT = np.full((28, 40), 255, dtype=np.uint8)
KEPT[5:20, 8:18] = 0
DROPPED = torch.from_numpy(KEPT == 0)


def redness(data: Dataset) -> float:
    """Mean of red minus green where photographs were painted red, in renders of a briefly trained `splat`."""
    model = Training(data, SplatRecipe(), iterations=500, device="cpu").run()
    images = [model.image(view.name)[DROPPED] for view in data.train]
    return float(torch.cat([image[:, 0] - image[:, 1] for image in images]).mean())


def test_splat_learns_nothing_of_what_is_black_in_masks_as_brush_has_them(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    shutil.rmtree(root / "panes")
    clean = redness(load_dataset(root))
    for path in sorted((root / "images").iterdir()):
        pixels = np.array(Image.open(path))
        pixels[KEPT == 0] = (255, 0, 0)
        Image.fromarray(pixels).save(path)
    painted = redness(load_dataset(root))
    (root / "masks").mkdir()
    for path in sorted((root / "images").iterdir()):
        Image.fromarray(KEPT).save(root / "masks" / f"{path.name}.png")
    masked = redness(load_dataset(root))
    assert painted - clean > 0.1 and abs(masked - clean) < 0.1 * (painted - clean), (clean, painted, masked)


def test_planar_learns_from_a_capture_of_earlier_versions_as_before(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    now = Training(load_dataset(root), PlanarRecipe(), iterations=16, device="cpu").run().scene
    (root / "panes").rename(root / "masks")
    before = Training(load_dataset(root), PlanarRecipe(), iterations=16, device="cpu").run().scene
    assert len(now.planes) == 1
    for name, tensor in now.parameters().items():
        assert torch.equal(tensor, before.parameters()[name]), name
