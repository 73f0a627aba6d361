"""Result of a loader, before photographs, masks and splits are looked at."""

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


@dataclass(frozen=True)
class RawPoints:
    """Coloured points in world space, as the files have them.

    Attributes:
        positions: [P, 3] float32, world units; infinite where they were beyond float32.
        colors: [P, 3] uint8 sRGB.
    """

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.positions)

    @staticmethod
    def from_arrays(positions: NDArray[Any], colors: NDArray[Any]) -> RawPoints:
        """Points from arrays of any real type.

        Positions beyond float32 become infinite.
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
    """One posed photograph as the data set describes it, distorted or not.

    Attributes:
        name: unique name with suffix, `/` between folders.
        image_path: the file.
        lens: of any model.
        cam_from_world: [4, 4] float64, OpenCV axes.
    """

    name: str
    image_path: Path
    lens: Lens
    cam_from_world: NDArray[np.float64]


@dataclass(frozen=True)
class Capture:
    """All that one data format says about a capture.

    Attributes:
        shots: every photograph, or those for training when the data set ships a split.
        test_shots: the photographs for testing; None leaves the split to the reader.
        points: sparse points, or None where the data set has none.
        format_name: for messages, such as "COLMAP".
        warnings: full sentences.
        random_points: how to place points when `points` is None; None takes the default.
        masks: masks of panes by name of the photograph where the format fixes them; None looks for them by name.
        kept: masks whose black is left out, by name of the photograph, where the format names them.
        cut_out: transparent pixels of photographs are left out; otherwise a background shows there.
    """

    shots: tuple[Shot, ...]
    test_shots: tuple[Shot, ...] | None
    points: RawPoints | None
    format_name: str
    warnings: tuple[str, ...] = ()
    random_points: Callable[[], RawPoints] | None = None
    masks: Mapping[str, Path] | None = None
    kept: Mapping[str, Path] | None = None
    cut_out: bool = False


Loader = Callable[[Path], Capture | None]
"""Reads a folder: None when it is not in the loader's format; raises `InputError` when it is, but broken."""
