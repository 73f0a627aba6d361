"""A copy of a capture with a flaw that real ones have; its true layers, poses and masks stay as they are.

python -m tools.spoil_capture CAPTURE --output COPY [--exposure STOPS] [--white-balance STOPS] [--seed N]

Photographs are brightened and tinted in linear radiance, as a camera's automatic exposure and white balance do, each by
factors of its own, and clipped at white.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from glassplat.files.images import read_image, write_image
from glassplat.kernels.color_space import linear_from_srgb, srgb_from_linear

IMAGES = "images"


def main() -> None:
    """Writes the copy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--output", type=Path, required=True, help="a folder that does not exist yet")
    parser.add_argument("--exposure", type=float, default=0.0, help="standard deviation of the exposure, in stops")
    parser.add_argument("--white-balance", type=float, default=0.0, help="the same of each channel beside it")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if not (given.capture / IMAGES).is_dir():
        parser.error(f"{given.capture} has no folder {IMAGES}")
    if given.output.exists():
        parser.error(f"{given.output} exists already; choose another --output")
    spoil(given.capture, given.output, given.exposure, given.white_balance, np.random.default_rng(given.seed))


def spoil(
    capture: Path, output: Path, exposure: float, white_balance: float, random: np.random.Generator
) -> dict[str, NDArray[np.float64]]:
    """Copies a capture with other exposures.

    Args:
        capture: its folder.
        output: of the copy.
        exposure: standard deviation of the exposures, in stops.
        white_balance: the same of each channel beside it.
        random: where they come from.

    Returns:
        The factors [3] on the linear channels, by photograph.
    """
    shutil.copytree(capture, output)
    factors = {}
    for path in sorted(path for path in (output / IMAGES).rglob("*") if path.is_file()):
        stops = exposure * random.standard_normal() + white_balance * random.standard_normal(3)
        factors[path.relative_to(output / IMAGES).as_posix()] = 2.0**stops
        write_image(path, exposed(read_image(path), 2.0**stops))
    return factors


def exposed(photo: NDArray[np.uint8], factors: NDArray[np.float64]) -> torch.Tensor:
    """A photograph [H, W, 3] whose linear channels are multiplied by factors [3], clipped at white."""
    linear = linear_from_srgb(torch.from_numpy(photo[..., :3].astype(np.float32)) / 255)
    brighter = (linear * torch.from_numpy(factors).float()).clamp(0, 1)
    return torch.round(255 * srgb_from_linear(brighter)).to(torch.uint8)


if __name__ == "__main__":
    main()
