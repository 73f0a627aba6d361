"""How far cameras are from where they were said to be, as readable JSON: six numbers for each photograph."""

from __future__ import annotations

from pathlib import Path

from glassplat.files.by_photograph import read_by_photograph, write_by_photograph
from glassplat.files.fields import Items, Number
from glassplat.scene.pose_correction import PoseCorrections

LARGEST = 1e2
TWIST = Items(Number(-LARGEST, LARGEST), 6)


def write_poses(path: Path, poses: PoseCorrections) -> None:
    """Writes the twists by photograph; `read_poses` returns them exactly."""
    write_by_photograph(path, poses.names, poses.twists)


def read_poses(path: Path) -> PoseCorrections:
    """Reads what `write_poses` wrote.

    Raises:
        FileNotFoundError, ValueError: the file is missing or foreign; says what is wrong.
    """
    names, twists = read_by_photograph(path, TWIST, (6,))
    return PoseCorrections(twists, names)
