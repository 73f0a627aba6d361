"""Split of a run's error into blur and wrong layers: fine and coarse errors, over the panes and elsewhere.

python -m tools.error_bands RUN [RUN ...] [--sigma 4]

Coarse is the difference to the photographs after a Gaussian blur, fine is the rest. Detail that is missing has a fine
error; a reflection that is missing, or stays in the transmission, a coarse one. The last column is what the true layers
themselves reach when put together: the noise of the photographs.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.table import Table
from glassplat.captures.dataset import Dataset
from glassplat.captures.view import View
from glassplat.cli.runs import StoredRun, open_run
from glassplat.evaluate.evaluate import timed_render
from glassplat.evaluate.metrics import quantized
from glassplat.evaluate.truth import TrueView, load_truth
from glassplat.kernels.maths.images import linear_from_srgb, srgb_from_linear

BANDS = ("all", "coarse", "fine")


def main() -> None:
    """Prints one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--sigma", type=float, default=4.0, help="standard deviation of the blur, pixels")
    arguments = parser.parse_args()
    columns = [f"{place}: {band}" for place in ("pane", "elsewhere") for band in BANDS]
    title = "PSNR of the mean squared error over all test views that show a pane, dB"
    table = Table(title, ("run", *columns, "pane: true layers"))
    for path in arguments.runs:
        stored = open_run(path)
        views = views_with_panes(stored.dataset)
        table.add(path.name, *error_bands(stored, views, arguments.sigma), noise_of_photographs(views))
    print(table.markdown())


def views_with_panes(dataset: Dataset) -> list[tuple[View, TrueView]]:
    """The test views of which the panes are known, with their true layers."""
    truth = load_truth(dataset.truth)
    if truth is None:
        raise SystemExit(f"{dataset.root} has no ground truth; expected gt/ with the panes of the test views")
    known = [(view, truth.view(view.name, view.camera.width, view.camera.height)) for view in dataset.test]
    return [(view, true) for view, true in known if true is not None and bool((true.labels > 0).any())]


def error_bands(stored: StoredRun, views: list[tuple[View, TrueView]], sigma: float) -> list[float]:
    """PSNR of all, coarse and fine errors over the panes, then elsewhere."""
    squares: dict[tuple[bool, str], list[NDArray[np.float64]]] = {}
    for view, true in views:
        frame, _ = timed_render(stored.renderer, stored.scene, view)
        error = quantized(frame.rgb).numpy().astype(np.float64) - view.photo.numpy()
        coarse = ndimage.gaussian_filter(error, (sigma, sigma, 0))
        for pane in (True, False):
            place = (true.labels > 0).numpy() == pane
            for band, values in zip(BANDS, (error, coarse, error - coarse), strict=True):
                squares.setdefault((pane, band), []).append(values[place] ** 2)
    return [psnr_of_squares(squares[pane, band]) for pane in (True, False) for band in BANDS]


def noise_of_photographs(views: list[tuple[View, TrueView]]) -> float:
    """PSNR over the panes of the true layers put together, where the true reflection is not clipped."""
    squares = []
    for view, true in views:
        transmission, reflection = (linear_from_srgb(layer / 255) for layer in (true.transmission, true.reflection))
        strength = true.strength[..., None]
        image = quantized(srgb_from_linear((1 - strength) * transmission + strength * reflection))
        place = (true.labels > 0) & (true.reflection < 255).all(dim=-1)
        squares.append((image[place].numpy().astype(np.float64) - view.photo[place].numpy()) ** 2)
    return psnr_of_squares(squares)


def psnr_of_squares(squares: list[NDArray[np.float64]]) -> float:
    """PSNR of squared differences of eight-bit values."""
    return -10 * math.log10(float(np.concatenate([values.ravel() for values in squares]).mean()) / 255**2)


if __name__ == "__main__":
    main()
