"""Makes the bundled demo scene: a capture with ground truth, shrunk by a whole factor.

Pictures are averaged in linear radiance, as a camera with larger pixels would see them, so that
photograph = (1 - strength) * transmission + strength * reflection still holds after shrinking.

    python tools/make_demo_scene.py --source CAPTURE --output glassplat/demo_scene
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

TEST_EVERY = 8
MOST_BYTES = 8_000_000
JPEG_QUALITY = 92

Shrink = Callable[[np.ndarray, int], np.ndarray]

README = """\
# The demo scene

A showcase behind glass in a bright room: {views} path-traced views of {width}x{height} pixels, made for this project
and licensed with it (Apache-2.0). It shows the layout that `glassplat train` reads:

| | |
|---|---|
| `images/` | the photographs |
| `sparse/0/` | the COLMAP text model: cameras, poses, points |
| `panes/` | the pane in {masks} of the views; a pixel is the label of its pane, 0 where there is none |
| `gt/` | the exact layers of the test views, every {every}th by name; used by `eval` only, a real capture has none |

Made by `tools/make_demo_scene.py` from a larger rendering of the same scene.
"""


@dataclass(frozen=True)
class Arguments:
    """Shrinks a capture to the size of a demo."""

    source: Path
    """Capture directory with images/, panes/, sparse/0/ as COLMAP text, and gt/."""
    output: Path
    """Directory to write; must not exist yet."""
    factor: int = 2
    """How many pixels of the source, along each axis, become one."""


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """sRGB values in [0, 1] of linear radiance in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """Linear radiance in [0, 1] of sRGB values in [0, 1]."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def blocks(pixels: np.ndarray, factor: int) -> np.ndarray:
    """[H, W, ...] as [H / factor, W / factor, factor * factor, ...]: the source pixels of every new pixel.

    Raises:
        ValueError: a side is not a multiple of `factor`.
    """
    height, width = pixels.shape[:2]
    if height % factor or width % factor:
        raise ValueError(
            f"an image of {width}x{height} cannot be shrunk by {factor}; choose a factor that divides both"
        )
    split = pixels.reshape(height // factor, factor, width // factor, factor, *pixels.shape[2:])
    return np.moveaxis(split, 1, 2).reshape(height // factor, width // factor, factor * factor, *pixels.shape[2:])


def shrink_picture(pixels: np.ndarray, factor: int) -> np.ndarray:
    """A [H, W, 3] uint8 sRGB picture, averaged in linear radiance."""
    linear = blocks(linear_from_srgb(pixels / 255.0), factor).mean(axis=2)
    return np.round(srgb_from_linear(linear) * 255.0).astype(np.uint8)


def shrink_strength(pixels: np.ndarray, factor: int) -> np.ndarray:
    """A [H, W] uint16 map of the Fresnel strength, averaged."""
    return np.round(blocks(pixels, factor).mean(axis=2)).astype(np.uint16)


def shrink_pane(labels: np.ndarray, factor: int) -> np.ndarray:
    """[H, W] labels of fully covered pixels: a new pixel is covered when all of its source pixels are."""
    parts = blocks(labels, factor)
    return np.where(parts.min(axis=2) == parts.max(axis=2), parts[:, :, 0], 0).astype(np.uint8)


def shrink_mask(labels: np.ndarray, factor: int) -> np.ndarray:
    """[H, W] annotated labels, the nearest source pixel of each new one."""
    return labels[factor // 2 :: factor, factor // 2 :: factor]


def convert(source: Path, target: Path, shrink: Shrink, *, factor: int) -> None:
    """Reads one picture, shrinks it and writes it under the same name."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(source) as picture:
        small = Image.fromarray(shrink(np.array(picture), factor))
    if target.suffix == ".jpg":
        # Colours keep their full resolution: the reflections differ from the background in colour.
        small.save(target, quality=JPEG_QUALITY, subsampling=0, optimize=True)
    else:
        small.save(target, optimize=True)


def convert_pictures(source: Path, output: Path, factor: int) -> None:
    """Shrinks the photographs, the masks and the ground truth."""
    shrinks: dict[str, Shrink] = {
        "images": shrink_picture,
        "panes": shrink_mask,
        "gt/trans": shrink_picture,
        "gt/refl": shrink_picture,
    }
    for folder, shrink in shrinks.items():
        for picture in sorted((source / folder).iterdir()):
            convert(picture, output / folder / picture.name, shrink, factor=factor)
    for picture in sorted((source / "gt/strength").iterdir()):
        shrink = shrink_pane if picture.stem.endswith("_pane") else shrink_strength
        convert(picture, output / "gt/strength" / picture.name, shrink, factor=factor)
    shutil.copyfile(source / "gt/planes.json", output / "gt/planes.json")


def shrink_camera(line: str, factor: int) -> str:
    """One line of cameras.txt: a PINHOLE camera over the smaller pixel grid."""
    number, model, width, height, *intrinsics = line.split()
    if model != "PINHOLE":
        raise ValueError(f"camera {number} is a {model}; expected PINHOLE, so undistort the capture first")
    scaled = [f"{float(value) / factor:.6f}" for value in intrinsics]
    return " ".join([number, model, str(int(width) // factor), str(int(height) // factor), *scaled])


def convert_model(source: Path, output: Path, factor: int) -> None:
    """Scales the intrinsics; poses and points stay as they are."""
    output.mkdir(parents=True)
    lines = [line for line in (source / "cameras.txt").read_text().splitlines() if line and not line.startswith("#")]
    (output / "cameras.txt").write_text("".join(shrink_camera(line, factor) + "\n" for line in lines))
    for name in ("images.txt", "points3D.txt"):
        shutil.copyfile(source / name, output / name)


def write_readme(output: Path) -> None:
    """Says what the scene is and who may use it."""
    images = sorted((output / "images").iterdir())
    with Image.open(images[0]) as picture:
        width, height = picture.size
    masks = len(list((output / "panes").iterdir()))
    text = README.format(views=len(images), width=width, height=height, masks=masks, every=TEST_EVERY)
    (output / "README.md").write_text(text)


def main(arguments: Arguments) -> None:
    """Writes the small scene and refuses one that is too large to bundle."""
    if arguments.output.exists():
        raise FileExistsError(f"{arguments.output} exists; expected a new directory, so remove it first")
    convert_model(arguments.source / "sparse/0", arguments.output / "sparse/0", arguments.factor)
    convert_pictures(arguments.source, arguments.output, arguments.factor)
    write_readme(arguments.output)
    size = sum(file.stat().st_size for file in arguments.output.rglob("*") if file.is_file())
    if size > MOST_BYTES:
        raise ValueError(f"the scene takes {size} bytes where {MOST_BYTES} are the most; choose a larger --factor")
    print(f"{arguments.output}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
