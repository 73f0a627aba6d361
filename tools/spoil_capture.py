"""Copies a capture and adds flaws of real captures; the true layers, poses and masks stay unchanged.

python -m tools.spoil_capture CAPTURE --output COPY [--exposure STOPS] [--white-balance STOPS]
                             [--pose-noise DEGREES] [--passers-by SHARE] [--seed N]

Photographs are scaled per channel in linear radiance, each by its own factors, like automatic exposure and white
balance, and clipped at white. Cameras of a COLMAP text model are rotated about each of their axes, and shifted as much
as the rotation moves points one camera radius away; `true_images.txt` keeps the true poses. These three flaws also work
for captures with `transforms_train.json`, such as those of `tools/make_scenes.py`. Passers-by occlude everything in
some photographs, except for test views (every eighth); `gt/passers_by/` has masks of them.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from glassplat.captures.dataset import TEST_EVERY
from glassplat.files.images import read_colors, write_image
from glassplat.kernels.maths.images import linear_from_srgb, srgb_from_linear

FIGURES = (0.4, 0.9)
"""Heights of passers-by, as shares of the photograph height."""
IMAGES, MODEL, TRUE_MODEL = "images", "sparse/0/images.txt", "true_images.txt"
SPLITS, TRANSFORMS = ("train", "test"), "transforms_{}.json"


def main() -> None:
    """Parses the arguments and writes the copy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--output", type=Path, required=True, help="a folder that does not exist yet")
    parser.add_argument("--exposure", type=float, default=0.0, help="standard deviation of the exposure, in stops")
    parser.add_argument("--white-balance", type=float, default=0.0, help="additional deviation of each channel")
    parser.add_argument("--pose-noise", type=float, default=0.0, help="standard deviation of the rotations, in degrees")
    parser.add_argument("--passers-by", type=float, default=0.0, help="share of the photographs with a passer-by")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    by_transforms = (given.capture / TRANSFORMS.format(SPLITS[0])).is_file()
    if not by_transforms and not (given.capture / IMAGES).is_dir():
        parser.error(f"{given.capture} has neither {IMAGES}/ nor {TRANSFORMS.format(SPLITS[0])}")
    if by_transforms and given.passers_by:
        parser.error(f"--passers-by takes a capture with {IMAGES}/")
    if given.output.exists():
        parser.error(f"{given.output} exists already; choose another --output")
    if given.pose_noise and not by_transforms and not (given.capture / MODEL).is_file():
        parser.error(f"{given.capture} has no {MODEL}; --pose-noise takes a COLMAP model in text, or transforms")
    random = np.random.default_rng(given.seed)
    spoil(given.capture, given.output, given.exposure, given.white_balance, random)
    if given.passers_by:
        add_passers_by(given.output, given.passers_by, random)
    if given.pose_noise and by_transforms:
        disturb_transforms(given.output, math.radians(given.pose_noise), random)
    elif given.pose_noise:
        disturb_poses(given.output / MODEL, math.radians(given.pose_noise), random)


def spoil(
    capture: Path, output: Path, exposure: float, white_balance: float, random: np.random.Generator
) -> dict[str, NDArray[np.float64]]:
    """Copies a capture with varied exposures.

    Args:
        capture: its folder.
        output: folder of the copy.
        exposure: standard deviation of the exposures, in stops.
        white_balance: additional standard deviation of each channel, in stops.
        random: random generator.

    Returns:
        Factors [3] of the linear channels by photograph; empty if photographs are unchanged.
    """
    shutil.copytree(capture, output)
    factors: dict[str, NDArray[np.float64]] = {}
    if not exposure and not white_balance:
        return factors
    for name, path in photographs(output):
        stops = exposure * random.standard_normal() + white_balance * random.standard_normal(3)
        factors[name] = 2.0**stops
        write_image(path, exposed(read_colors(path), 2.0**stops))
    return factors


def photographs(capture: Path) -> list[tuple[str, Path]]:
    """Names and paths of the photographs of a capture, from `images/` or from its transforms."""
    if (capture / IMAGES).is_dir():
        paths = sorted(path for path in (capture / IMAGES).rglob("*") if path.is_file())
        return [(path.relative_to(capture / IMAGES).as_posix(), path) for path in paths]
    names = [Path(frame["file_path"]).as_posix() + ".png" for split in SPLITS for frame in frames_of(capture, split)]
    return [(name, capture / name) for name in names]


def frames_of(capture: Path, split: str) -> list[dict[str, Any]]:
    """Frames in `transforms_train.json` or `transforms_test.json` of a capture."""
    frames: list[dict[str, Any]] = json.loads((capture / TRANSFORMS.format(split)).read_text())["frames"]
    return frames


def disturb_transforms(capture: Path, noise: float, random: np.random.Generator) -> None:
    """Perturbs every camera of a capture with transforms independently, like `disturb_poses`.

    Args:
        capture: its folder; `true_transforms_train.json` and `..._test.json` are kept next to the new ones.
        noise: standard deviation of the rotations about each axis, radians, and of the shifts, in camera radii.
        random: random generator.
    """
    for split in SPLITS:
        path = capture / TRANSFORMS.format(split)
        shutil.copyfile(path, path.with_name("true_" + path.name))
        record = json.loads(path.read_text())
        poses = np.array([frame["transform_matrix"] for frame in record["frames"]])
        centers = poses[:, :3, 3]
        radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
        wobbles = np.broadcast_to(np.eye(4), poses.shape).copy()
        wobbles[:, :3, :3] = Rotation.from_rotvec(noise * random.standard_normal((len(poses), 3))).as_matrix()
        wobbles[:, :3, 3] = noise * radius * random.standard_normal((len(poses), 3))
        for frame, pose in zip(record["frames"], poses @ wobbles, strict=True):
            frame["transform_matrix"] = pose.tolist()
        path.write_text(json.dumps(record, indent=1) + "\n")


def disturb_poses(path: Path, noise: float, random: np.random.Generator) -> None:
    """Perturbs every camera of a COLMAP model independently.

    Args:
        path: its `images.txt`; the true one is kept next to it.
        noise: standard deviation of the rotations about each axis, radians, and of the shifts, in camera radii.
        random: random generator.
    """
    lines = path.read_text().splitlines()
    shutil.copyfile(path, path.with_name(TRUE_MODEL))
    places = [n for n, line in enumerate(lines) if len(line.split()) == 10 and not line.startswith("#")]
    poses = np.array([[float(word) for word in lines[n].split()[1:8]] for n in places])
    turns = Rotation.from_quat(poses[:, [1, 2, 3, 0]])
    centers = -turns.inv().apply(poses[:, 4:])
    radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    wobbles = Rotation.from_rotvec(noise * random.standard_normal((len(places), 3)))
    shifts = wobbles.apply(poses[:, 4:]) + noise * radius * random.standard_normal((len(places), 3))
    for n, (x, y, z, w), shift in zip(places, (wobbles * turns).as_quat(), shifts, strict=True):
        first, *_, camera, name = lines[n].split()
        values = " ".join(f"{value:.9f}" for value in (w, x, y, z, *shift))
        lines[n] = f"{first} {values} {camera} {name}"
    path.write_text("\n".join(lines) + "\n")


def add_passers_by(capture: Path, share: float, random: np.random.Generator) -> None:
    """Paints passers-by into photographs of a capture, and writes masks of them.

    Args:
        capture: its folder.
        share: share of the photographs, excluding test views.
        random: random generator.
    """
    paths = sorted(path for path in (capture / IMAGES).rglob("*") if path.is_file())
    for number, path in enumerate(paths):
        if number % TEST_EVERY == 0 or random.random() >= share:
            continue
        photo = read_colors(path)[..., :3].copy()
        body = figure(photo.shape[0], photo.shape[1], random)
        clothes = random.uniform(0, 255, 3) + random.normal(scale=12, size=(int(body.sum()), 3))
        photo[body] = np.clip(clothes, 0, 255).astype(np.uint8)
        write_image(path, torch.from_numpy(photo))
        mask = capture / "gt/passers_by" / path.relative_to(capture / IMAGES).with_suffix(".png")
        mask.parent.mkdir(parents=True, exist_ok=True)
        write_image(mask, torch.from_numpy(255 * body.astype(np.uint8)))


def figure(height: int, width: int, random: np.random.Generator) -> NDArray[np.bool_]:
    """[H, W] mask of a standing person: a head, and a body down to the feet."""
    size = random.uniform(*FIGURES) * height
    middle, feet = random.uniform(0.1, 0.9) * width, random.uniform(0.7, 1.2) * height
    y, x = np.mgrid[:height, :width] + 0.5
    head = (x - middle) ** 2 + (y - (feet - 0.92 * size)) ** 2 < (0.08 * size) ** 2
    body = ((x - middle) / (0.17 * size)) ** 4 + ((y - (feet - 0.42 * size)) / (0.42 * size)) ** 4 < 1
    found: NDArray[np.bool_] = head | body
    return found


def exposed(photo: NDArray[np.uint8], factors: NDArray[np.float64]) -> torch.Tensor:
    """A photograph [H, W, 3 or 4] with linear channels multiplied by factors [3], clipped at white."""
    linear = linear_from_srgb(torch.from_numpy(photo[..., :3].astype(np.float32)) / 255)
    brighter = (linear * torch.from_numpy(factors).float()).clamp(0, 1)
    colors = torch.round(255 * srgb_from_linear(brighter)).to(torch.uint8)
    return torch.cat([colors, torch.from_numpy(photo[..., 3:].copy())], dim=-1)


if __name__ == "__main__":
    main()
