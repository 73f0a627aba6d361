"""Errors of fitted planes against the true ones, over many choices of a few masks.

python -m tools.plane_errors --data SCENE [SCENE ...] --masks 3

A scene needs pane masks and `gt/planes.json`. Each pane is fitted from every choice of that many of the masks that show
it, as training does before its first iteration; `--splats` takes the centres of a trained scene instead.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from benchmarks.table import Table
from glassplat.captures.dataset import Dataset, load_dataset
from glassplat.evaluate.metrics import plane_table
from glassplat.evaluate.truth import GroundTruth, load_truth
from glassplat.files.ply import read_gaussians
from glassplat.panes import PlaneFitError
from glassplat.panes.fit import fit_planes

COLUMNS = ("scene / pane", "fits", "refused", "good", "degrees, median (max)", "% of extent, median (max)", "seconds")
LEAST_SHARE = 0.01
"""Masks that show a pane on less of the image are not among those that are chosen from."""
LIMITS = 1.0, 1.0
"""Degrees and per cent of the extent up to which a plane counts as found."""


@dataclass(frozen=True)
class Fit:
    """One fit of one pane.

    Attributes:
        names: of the photographs whose masks were used.
        errors: angle between the planes, degrees, and distance of the true pane's centre from the fitted plane, % of
            the extent; None where no plane was found.
        seconds: processor time taken by the fit.
    """

    names: tuple[str, ...]
    errors: tuple[float, float] | None
    seconds: float

    @property
    def good(self) -> bool:
        """Return whether the plane is within the limits."""
        return self.errors is not None and self.errors[0] <= LIMITS[0] and self.errors[1] <= LIMITS[1]


def main() -> None:
    """Prints a markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--masks", type=int, help="masks per fit; all if not given")
    parser.add_argument("--splats", type=Path, nargs="+", help="one trained .ply per scene, instead of its points")
    parser.add_argument("--every", type=int, default=1, help="use every n-th choice of masks")
    parser.add_argument("--verbose", action="store_true", help="print every fit")
    arguments = parser.parse_args()
    table = Table("Errors of fitted planes", COLUMNS)
    for root, splats in zip(arguments.data, arguments.splats or [None] * len(arguments.data), strict=True):
        dataset = load_dataset(root)
        truth = load_truth(dataset.truth)
        if truth is None:
            raise SystemExit(f"{root} has no ground truth; expected gt/planes.json with the true panes")
        centers = dataset.points.positions if splats is None else read_gaussians(splats).means
        for pane in truth.planes:
            fits = []
            for fit in fits_of(dataset, centers, truth, pane.label, arguments.masks, arguments.every):
                fits.append(fit)
                if arguments.verbose:
                    print(f"  {' '.join(fit.names)}: {fit.errors or 'refused'}, {fit.seconds:.1f} s", flush=True)
            table.add(*row(f"{root.name} {pane.label}", fits))
    print(table.markdown())


def fits_of(
    dataset: Dataset, centers: Tensor, truth: GroundTruth, label: int, masks: int | None = None, every: int = 1
) -> Iterator[Fit]:
    """Every fit of one pane, from each choice of so many of the masks that show it."""
    shown = [
        (view.name, view.camera, view.pane_labels)
        for view in dataset.train
        if view.pane_labels is not None and float((view.pane_labels == label).float().mean()) >= LEAST_SHARE
    ]
    for chosen in list(itertools.combinations(shown, masks or len(shown)))[::every]:
        start = time.process_time()
        try:
            annotations = [(camera, labels) for _, camera, labels in chosen]
            planes = fit_planes(centers, annotations, extent=dataset.extent, labels=[label])
        except PlaneFitError:
            errors = None
        else:
            (entry,) = plane_table(planes, truth, dataset.extent)
            errors = entry["normal_error_deg"], 100 * entry["offset_error"]
        yield Fit(tuple(Path(name).stem for name, _, _ in chosen), errors, time.process_time() - start)


def row(name: str, fits: Sequence[Fit]) -> list[object]:
    """One line of the table."""
    found = [fit.errors for fit in fits if fit.errors is not None]
    spreads = [f"{statistics.median(values):.2f} ({max(values):.2f})" for values in zip(*found, strict=True)]
    seconds = statistics.fmean(fit.seconds for fit in fits) if fits else "-"
    return [name, len(fits), len(fits) - len(found), sum(f.good for f in fits), *(spreads or ["-", "-"]), seconds]


if __name__ == "__main__":
    main()
