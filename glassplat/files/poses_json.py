"""How far cameras are from where they were said to be, as readable JSON: six numbers for each photograph."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from glassplat.files.atomic import atomic_write
from glassplat.files.fields import ByName, Items, Number
from glassplat.files.json_text import read_json
from glassplat.scene.pose_correction import PoseCorrections

LARGEST = 1e2
TWISTS = ByName(Items(Number(-LARGEST, LARGEST), 6))


def write_poses(path: Path, poses: PoseCorrections) -> None:
    """Writes the twists by photograph; `read_poses` returns them exactly."""
    twists = dict(zip(poses.names, poses.twists.detach().cpu().tolist(), strict=True))
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(twists, indent=1) + "\n", encoding="utf-8")


def read_poses(path: Path) -> PoseCorrections:
    """Reads what `write_poses` wrote.

    Raises:
        FileNotFoundError, ValueError: the file is missing or foreign; says what is wrong.
    """
    twists = TWISTS.read(read_json(path), str(path))
    names = tuple(twists)
    return PoseCorrections(torch.tensor(list(twists.values()), dtype=torch.float32).reshape(len(names), 6), names)
