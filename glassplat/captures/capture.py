"""Result of a loader, before photographs and masks are read and test views are chosen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glassplat.captures.cameras import Lens
from glassplat.errors import InputError

HIGHEST_COLOR = 255
"""Largest value of a colour channel of a point."""


@dataclass(frozen=True)
class RawPoints:
    """Coloured points in world space, as stored in the files.

    Attributes:
        positions: [P, 3] float32, world units; infinite where the stored value exceeds float32.
        colors: [P, 3] uint8 sRGB.
    """

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.positions)

    @staticmethod
    def from_arrays(positions: NDArray[Any], colors: NDArray[Any]) -> RawPoints:
        """Points from arrays of any real type.

        Positions that exceed float32 become infinite.
        """
        colors = np.asarray(colors)
        outside = ~((colors >= 0) & (colors <= HIGHEST_COLOR))
        if outside.any():
            raise InputError(f"a point has the colour value {colors[outside][0]:g}; expected 0 to {HIGHEST_COLOR}")
        with np.errstate(over="ignore"):
            positions = np.ascontiguousarray(positions, dtype=np.float32).reshape(-1, 3)
        return RawPoints(positions, np.ascontiguousarray(colors, dtype=np.uint8).reshape(-1, 3))


@dataclass(frozen=True)
class Shot:
    """One posed photograph with its lens, which may be distorted.

    Attributes:
        name: unique name with suffix, `/` between folders.
        image_path: the file.
        lens: of any camera model.
        cam_from_world: [4, 4] float64, OpenCV axes.
    """

    name: str
    image_path: Path
    lens: Lens
    cam_from_world: NDArray[np.float64]


@dataclass(frozen=True)
class Capture:
    """Contents of a capture as one data format describes it.

    Attributes:
        shots: all photographs, or the training photographs if the data set ships a split.
        test_shots: test photographs; None lets `load_dataset` choose the split.
        points: sparse points; None if the data set has none.
        format_name: for messages, such as "COLMAP".
        warnings: full sentences.
        random_points: generator of points if `points` is None; None uses the default.
        masks: pane masks by name of the photograph if the format specifies them; None finds them by file name.
        keep_masks: masks whose black pixels are ignored, by name of the photograph, if the format names them.
        ignores_transparent: transparent pixels of photographs are ignored; otherwise they show a background.
    """

    shots: tuple[Shot, ...]
    test_shots: tuple[Shot, ...] | None
    points: RawPoints | None
    format_name: str
    warnings: tuple[str, ...] = ()
    random_points: Callable[[], RawPoints] | None = None
    masks: Mapping[str, Path] | None = None
    keep_masks: Mapping[str, Path] | None = None
    ignores_transparent: bool = False


Loader = Callable[[Path], Capture | None]
"""Reads a folder; returns None if it is in another format, and raises `InputError` if it is broken."""
