"""How photographs were exposed, as readable JSON: a transform of three rows of four numbers for each."""

from __future__ import annotations

from pathlib import Path

from glassplat.files.by_photograph import read_by_photograph, write_by_photograph
from glassplat.files.fields import Items, Number
from glassplat.scene.exposure import Exposures

LARGEST = 1e3
TRANSFORM = Items(Items(Number(-LARGEST, LARGEST), 4), 3)


def write_exposures(path: Path, exposures: Exposures) -> None:
    """Writes the transforms by photograph; `read_exposures` returns them exactly."""
    write_by_photograph(path, exposures.names, exposures.affine)


def read_exposures(path: Path) -> Exposures:
    """Reads what `write_exposures` wrote.

    Raises:
        FileNotFoundError, ValueError: the file is missing or foreign; says what is wrong.
    """
    names, affine = read_by_photograph(path, TRANSFORM, (3, 4))
    return Exposures(affine, names)
