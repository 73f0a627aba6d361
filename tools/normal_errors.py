"""Normal errors of a `deferred` run, by what the true surface mirrors: the sky, the horizon or the ground.

python -m tools.normal_errors RUN [RUN ...]

Made for the scenes of `tools.make_scenes`, where z is up and the ground is near. An environment infinitely far away
cannot show the ground as a ball sees it, so normals are found only where something distant is mirrored.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.table import Table
from glassplat.captures.view import View
from glassplat.cli.runs import StoredRun, open_run
from glassplat.evaluate.evaluate import timed_render
from glassplat.evaluate.metrics import REFLECTIVE, angular_errors_deg
from glassplat.evaluate.truth import true_surface
from glassplat.render.deferred import view_directions

EDGES = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Bounds of the bands: the upward share of the mirrored ray."""


def main() -> None:
    """Prints one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    arguments = parser.parse_args()
    bands = [f"{low:+g} to {high:+g}" for low, high in itertools.pairwise(EDGES)]
    table = Table("Normal errors by the upward share of the mirrored ray, deg (share of the pixels)", ("run", *bands))
    for path in arguments.runs:
        upward, errors = mirrored_errors(open_run(path))
        table.add(path.name, *(f"{error:.1f} ({share:.0%})" for error, share in errors_by_band(upward, errors)))
    print(table.markdown())


def mirrored_errors(stored: StoredRun) -> tuple[Tensor, Tensor]:
    """Upward shares [P] of the true mirrored rays and normal errors [P] in degrees, at all mirror-like test pixels."""
    upward, errors = [], []
    for view in stored.dataset.test:
        truth = true_surface(view)
        if truth is None or truth.normals is None or truth.strength is None:
            raise SystemExit(f"{view.image_path} has no true normals and strength next to it; expected a made scene")
        frame, _ = timed_render(stored.renderer, stored.scene, view)
        mirror = truth.covered & (truth.strength > REFLECTIVE)
        upward.append(mirrored_rays(view, truth.normals)[mirror][:, 2])
        errors.append(angular_errors_deg(frame.layers["normal"], truth.normals)[mirror])
    return torch.cat(upward), torch.cat(errors)


def mirrored_rays(view: View, normals: Tensor) -> Tensor:
    """Unit directions [H, W, 3] in world axes in which the rays of a view leave a surface with these normals."""
    rays = torch.nn.functional.normalize(view_directions(view.camera), dim=-1).to(normals)
    return rays - 2 * (rays * normals).sum(dim=-1, keepdim=True) * normals


def errors_by_band(upward: Tensor, errors: Tensor) -> list[tuple[float, float]]:
    """Mean error and share of the pixels in each band; the mean of none is NaN."""
    rows = torch.bucketize(upward, torch.tensor(EDGES[1:-1]), right=True)
    members = [errors[rows == row] for row in range(len(EDGES) - 1)]
    return [(float(found.mean()), found.numel() / max(errors.numel(), 1)) for found in members]


if __name__ == "__main__":
    main()
