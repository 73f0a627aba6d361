"""How much of a run's error is blur and how much a wrong layer: fine and coarse errors, over the panes and elsewhere.

python -m tools.error_bands RUN [RUN ...] [--sigma 4]

Coarse is the difference to the photographs after a Gaussian blur, fine is the rest. Detail that is missing has a fine
error; a reflection that is missing, or stays in the transmission, a coarse one.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from glassplat.commands.stored_run import StoredRun, open_run
from glassplat.evaluate.evaluate import timed_render
from glassplat.evaluate.metrics import quantized
from glassplat.evaluate.truth import load_truth
from glassplat.files.markdown_table import Table

BANDS = ("all", "coarse", "fine")


def main() -> None:
    """Prints one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--sigma", type=float, default=4.0, help="standard deviation of the blur, pixels")
    arguments = parser.parse_args()
    columns = [f"{place}: {band}" for place in ("pane", "elsewhere") for band in BANDS]
    table = Table("PSNR of the mean squared error over all test views that show a pane, dB", ("run", *columns))
    for path in arguments.runs:
        table.add(path.name, *error_bands(open_run(path), arguments.sigma))
    print(table.markdown())


def error_bands(stored: StoredRun, sigma: float) -> list[float]:
    """PSNR of all, coarse and fine errors over the panes, then elsewhere."""
    truth = load_truth(stored.dataset.truth) if stored.dataset.truth else None
    if truth is None:
        raise SystemExit(f"{stored.dataset.root} has no ground truth; expected gt/ with the panes of the test views")
    squares: dict[tuple[bool, str], list[NDArray[np.float64]]] = {}
    for view in stored.dataset.test:
        true = truth.view(view.name, view.camera.width, view.camera.height)
        if true is None or not (true.labels > 0).any():
            continue
        frame, _ = timed_render(stored.renderer, stored.scene, view)
        error = quantized(frame.rgb).numpy().astype(np.float64) - view.photo.numpy()
        coarse = ndimage.gaussian_filter(error, (sigma, sigma, 0))
        for pane in (True, False):
            place = (true.labels > 0).numpy() == pane
            for band, values in zip(BANDS, (error, coarse, error - coarse), strict=True):
                squares.setdefault((pane, band), []).append(values[place] ** 2)
    return [
        -10 * math.log10(float(np.concatenate(squares[pane, band]).mean()) / 255**2)
        for pane in (True, False)
        for band in BANDS
    ]


if __name__ == "__main__":
    main()
