"""How photographs were exposed, as readable JSON: a transform of three rows of four numbers for each."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from glassplat.files.atomic import atomic_write
from glassplat.files.fields import ByName, Items, Number
from glassplat.files.json_text import read_json
from glassplat.scene.exposure import Exposures

LARGEST = 1e3
TRANSFORMS = ByName(Items(Items(Number(-LARGEST, LARGEST), 4), 3))


def write_exposures(path: Path, exposures: Exposures) -> None:
    """Writes the transforms by photograph; `read_exposures` returns them exactly."""
    transforms = dict(zip(exposures.names, exposures.affine.detach().cpu().tolist(), strict=True))
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(transforms, indent=1) + "\n", encoding="utf-8")


def read_exposures(path: Path) -> Exposures:
    """Reads what `write_exposures` wrote.

    Raises:
        FileNotFoundError, ValueError: the file is missing or foreign; says what is wrong.
    """
    transforms = TRANSFORMS.read(read_json(path), str(path))
    names = tuple(transforms)
    return Exposures(torch.tensor(list(transforms.values()), dtype=torch.float32).reshape(len(names), 3, 4), names)
