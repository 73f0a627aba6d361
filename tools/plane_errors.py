"""How far fitted planes are from the true ones, over many choices of a few masks.

python -m tools.plane_errors --data SCENE [SCENE ...] --masks 3

A scene needs pane masks and `gt/planes.json`. Each pane is fitted from every choice of that many of the masks that show
it, as training does before its first iteration; `--splats` takes the centres of a trained scene instead.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.data.dataset import Dataset, load_dataset
from glassplat.files.ply import read_gaussians
from glassplat.init.planes import PlaneFitError, fit_planes
from glassplat.scene.camera import Camera

Array = NDArray[np.float64]
Annotations = list[tuple[Camera, Tensor]]

LEAST_SHARE = 0.01
"""Masks that show a pane on less of the image are not among those that are chosen from."""
LIMITS = 1.0, 1.0
"""Degrees and per cent of the extent up to which a plane counts as found."""


@dataclass(frozen=True)
class Fit:
    """One fit of one pane.

    Attributes:
        names: of the photographs whose masks were used.
        degrees: angle between the planes; infinite where no plane was found.
        percent: distance of the true pane's centre from the fitted plane, % of the extent.
        seconds: processor time taken by the fit.
    """

    names: tuple[str, ...]
    degrees: float
    percent: float
    seconds: float

    @property
    def good(self) -> bool:
        """Whether the plane is within the limits."""
        return self.degrees <= LIMITS[0] and self.percent <= LIMITS[1]


def main() -> None:
    """Prints a markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--masks", type=int, help="masks per fit; all if not given")
    parser.add_argument("--splats", type=Path, nargs="+", help="one trained .ply per scene, instead of its points")
    parser.add_argument("--every", type=int, default=1, help="use every n-th choice of masks")
    parser.add_argument("--verbose", action="store_true", help="print every fit")
    arguments = parser.parse_args()
    print("| scene / pane | fits | refused | good | degrees, median (max) | % of extent, median (max) | seconds |")
    print("|---|---|---|---|---|---|---|")
    for number, root in enumerate(arguments.data):
        dataset = load_dataset(root)
        splats = arguments.splats[number] if arguments.splats else None
        centers = dataset.points.positions if splats is None else read_gaussians(splats).means
        for pane in json.loads((root / "gt" / "planes.json").read_text()):
            fits = []
            for fit in fits_of(dataset, centers, pane, arguments.masks, arguments.every):
                fits.append(fit)
                if arguments.verbose:
                    print(f"  {' '.join(fit.names)}: {fit.degrees:.2f} deg {fit.percent:.2f} % {fit.seconds:.1f} s")
            print(row(f"{root.name} {pane['label']}", fits), flush=True)


def fits_of(dataset: Dataset, centers: Tensor, pane: dict, masks: int | None, every: int) -> Iterator[Fit]:
    """Every fit of one pane, from each choice of so many masks."""
    label = pane["label"]
    shown = [
        (view.name, view.camera, torch.where(view.pane_labels == label, label, 0))
        for view in dataset.train
        if view.pane_labels is not None and float((view.pane_labels == label).float().mean()) >= LEAST_SHARE
    ]
    for chosen in list(itertools.combinations(shown, masks or len(shown)))[::every]:
        names = tuple(Path(name).stem for name, _, _ in chosen)
        start = time.process_time()
        degrees, percent = errors([(c, labels) for _, c, labels in chosen], centers, dataset.extent, pane)
        yield Fit(names, degrees, percent, time.process_time() - start)


def errors(annotations: Annotations, centers: Tensor, extent: float, pane: dict) -> tuple[float, float]:
    """Degrees and % of the extent between the fitted plane and the true one; infinite if there is none."""
    try:
        planes = fit_planes(centers, annotations, extent=extent)
    except PlaneFitError:
        return float("inf"), float("inf")
    normal = planes.normals[0].double().numpy()
    cosine = abs(float(normal @ np.array(pane["normal"])))
    away = float((np.array(pane["center"]) - planes.centers[0].double().numpy()) @ normal)
    return float(np.degrees(np.arccos(min(cosine, 1.0)))), 100 * abs(away) / extent


def row(name: str, fits: Sequence[Fit]) -> str:
    """One line of the table."""
    found = [fit for fit in fits if np.isfinite(fit.degrees)]
    degrees, percent = np.array([fit.degrees for fit in found]), np.array([fit.percent for fit in found])
    cells = [name, str(len(fits)), str(len(fits) - len(found)), str(sum(fit.good for fit in fits))]
    for values in (degrees, percent):
        cells.append(f"{np.median(values):.2f} ({values.max():.2f})" if len(values) else "-")
    cells.append(f"{np.mean([fit.seconds for fit in fits]):.1f}")
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
