"""A data set of three tiny test views with ground truth, and renderers that need no kernels."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import PointCloud, View
from glassplat.render.frame import Frame
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene

WIDTH, HEIGHT = 48, 32
NAMES = ("a.jpg", "b.jpg", "c.jpg")


@dataclass(frozen=True)
class RecordedRenderer:
    """Returns the recorded frame of each camera, identified by fx."""

    frames: dict[float, Frame]
    calls: list[float] = field(default_factory=list)

    def __call__(self, scene: Scene, camera: Camera) -> Frame:
        self.calls.append(camera.fx)
        return self.frames[camera.fx]

    def with_layers(self, **changes: Tensor) -> "RecordedRenderer":
        """The same renderer with some layers replaced in every frame."""
        return RecordedRenderer({k: replace(f, layers=dict(f.layers) | changes) for k, f in self.frames.items()})

    def without_layers(self) -> "RecordedRenderer":
        """The same renderer for a method that renders an image and no layers."""
        return RecordedRenderer({k: replace(f, layers={}) for k, f in self.frames.items()})


@dataclass(frozen=True)
class Case:
    """The inputs of a test of the evaluation."""

    dataset: Dataset
    renderer: RecordedRenderer
    scene: Scene


def pane_labels(index: int) -> np.ndarray:
    """The first view shows two panes, the second one, the third none."""
    labels = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    if index < 2:
        labels[4:20, 6:30] = 1
    if index == 0:
        labels[4:20, 32:44] = 2
    return labels


def write_truth(folder: Path, index: int, name: str) -> None:
    random = np.random.default_rng(index)
    labels = pane_labels(index)
    stem = Path(name).stem
    for kind in ("trans", "refl", "strength"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for kind in ("trans", "refl"):
        pixels = random.integers(0, 150, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / kind / f"{stem}.png")
    strength = np.where(labels > 0, 6553, 0).astype(np.uint16)
    Image.fromarray(strength).save(folder / "strength" / f"{stem}.png")
    Image.fromarray(labels).save(folder / "strength" / f"{stem}_pane.png")


def true_panes() -> list[dict[str, object]]:
    shared = {"half_u": [1, 0, 0], "half_v": [0, 1, 0], "ior": 1.5, "mirror": False, "base_reflectance": 0.08}
    return [
        {"label": 1, "center": [0.0, 1.0, 2.0], "normal": [0.0, 0.0, 1.0], **shared},
        {"label": 2, "center": [1.0, 0.0, 0.0], "normal": [1.0, 0.0, 0.0], **shared},
    ]


def perfect_frame(folder: Path, index: int, name: str) -> Frame:
    """Layers equal to the ground truth on the panes, but the reflection at half its brightness; noise elsewhere."""
    stem = Path(name).stem
    read = {kind: np.asarray(Image.open(folder / kind / f"{stem}.png")) for kind in ("trans", "refl")}
    images = {kind: torch.from_numpy(pixels.astype(np.float32) / 255) for kind, pixels in read.items()}
    pane = torch.from_numpy(pane_labels(index) > 0).float()
    noise = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(index))
    layers = {
        "transmission": torch.where(pane[..., None] > 0, images["trans"], noise),
        "without_panes": images["trans"],
        "reflection": torch.where(pane[..., None] > 0, 0.5 * images["refl"], noise),
        "strength": 0.1 * pane,
        "share": 0.1 * pane,
        "mask": pane,
        "depth": torch.linspace(1, 3, WIDTH).expand(HEIGHT, WIDTH),
        "alpha": torch.ones(HEIGHT, WIDTH),
    }
    return Frame(images["trans"] * 0.9 + 0.05, layers)


def camera_of(index: int) -> Camera:
    return Camera(torch.eye(4), 40.0 + index, 40.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


@pytest.fixture
def case(tmp_path: Path) -> Case:
    """Three test views; frames with perfect transmission and a reflection at half brightness."""
    folder = tmp_path / "capture" / "gt"
    views, frames = [], {}
    for index, name in enumerate(NAMES):
        write_truth(folder, index, name)
        frames[40.0 + index] = perfect_frame(folder, index, name)
        photo = torch.full((HEIGHT, WIDTH, 3), 100 + index, dtype=torch.uint8)
        views.append(View.in_memory(name, camera_of(index), photo=photo))
    (folder / "planes.json").write_text(json.dumps(true_panes()))
    points = PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    dataset = Dataset(
        folder.parent, (), tuple(views), points, extent=4.0, truth=folder, split="every 8th image by name"
    )
    planes = Planes(
        centers=torch.tensor([[0.5, 0.5, 2.1]]),
        raw_normals=torch.tensor([[0.0, 0.0, -3.0]]),
        logit_reflectances=torch.tensor([0.0]),
        tangents=torch.tensor([[1.0, 0.0, 0.0]]),
        half_sizes=torch.ones(1, 2),
        labels=(1,),
    )
    return Case(dataset, RecordedRenderer(frames), Scene(Gaussians.empty(1), extent=4.0, planes=planes))
