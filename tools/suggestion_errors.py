"""Compares the panes that `glassplat annotate --suggest` proposes with the true ones of synthetic scenes.

    python -m tools.suggestion_errors SCENE...

A scene's true panes are those in its `gt/planes.json`; a capture without that file should have no suggestion, or ones
that somebody looks at.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from glassplat.data.dataset import load_dataset
from glassplat.suggest.suggestion import Suggestion, suggested_panes

TRUTH = Path("gt") / "planes.json"


def errors(found: Suggestion, true: dict, extent: float) -> tuple[float, float]:
    """Degrees between two panes' normals, and how far the true centre lies from the found plane, in extents."""
    normal = np.array(true["normal"])
    turned = float(np.degrees(np.arccos(min(1.0, abs(found.normal @ normal)))))
    away = (np.array(true["center"]) - found.corners.mean(axis=0)) @ found.normal
    return turned, abs(float(away)) / extent


def report(scene: Path) -> None:
    """Prints what is found in one capture, and how far it is off."""
    dataset = load_dataset(scene)
    begun = time.process_time()
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.name)
    found = suggested_panes(views, float(dataset.extent), lambda what, done, count: None)
    seconds = time.process_time() - begun
    print(
        f"{scene.name}: {len(found)} panes in {seconds:.0f} s of processor time, {len(views)} photographs", flush=True
    )
    truth = json.loads((scene / TRUTH).read_text()) if (scene / TRUTH).is_file() else []
    for one in found:
        print(f"  {one.described()}", flush=True)
        for pane in truth:
            turned, away = errors(one, pane, float(dataset.extent))
            print(f"    pane {pane['label']}: {turned:.2f} degrees, {away:.4f} extents", flush=True)


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    for scene in parser.parse_args().scenes:
        report(scene)


if __name__ == "__main__":
    main()
