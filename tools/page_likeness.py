"""How like the web page of a run is to its render, and how long the page takes for a picture.

python -m tools.page_likeness runs/showcase out/index.html
"""

from __future__ import annotations

import base64
import json
import statistics
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from glassplat.commands.publishing.exporting import cameras_of
from glassplat.evaluate.metrics import psnr
from glassplat.files.spz_sections import FLIP
from glassplat.interface.loading import load
from glassplat.interface.model import Model
from glassplat.scene.camera import Camera
from tools.browser import Browser

VIEWS = 5
FRAMES = 6


def wanted(camera: Camera, layer: str) -> str:
    """A call of the page's script for the picture of a camera."""
    flip = torch.tensor(FLIP)
    rotation, position = camera.cam_from_world[:3, :3] * flip, camera.center * flip
    values: dict[str, Any] = {"rotation": rotation.flatten().tolist(), "position": position.tolist()}
    values |= {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    values |= {"layers": [layer, layer]}
    return f"glassplat.then(page => page.picture({json.dumps(values)}))"


def picture(browser: Browser, camera: Camera, layer: str = "rgb") -> torch.Tensor:
    """What the page shows of a layer, [H, W, 3] uint8."""
    pixels = np.frombuffer(base64.b64decode(browser.evaluate(wanted(camera, layer))), dtype=np.uint8)
    return torch.from_numpy(pixels.reshape(camera.height, camera.width, 4)[::-1, :, :3].copy())


def likenesses(browser: Browser, model: Model) -> list[float]:
    """PSNR of the page's pictures against the renders of some test cameras."""
    cameras = cameras_of(model, "test")
    found = []
    for camera in cameras[:: max(1, len(cameras) // VIEWS)][:VIEWS]:
        with torch.no_grad():
            truth = model.renderer(model.scene, camera).rgb
        found.append(psnr(picture(browser, camera), truth.clamp(0, 1)))
    return found


def main() -> None:
    """Prints both."""
    run, page = map(Path, sys.argv[1:3])
    model = load(run, device="cpu")
    with Browser(page, 640, 480) as browser:
        found = likenesses(browser, model)
        print(
            f"{page.stat().st_size / 1e6:.2f} MB, PSNR of {len(found)} views: {', '.join(f'{x:.1f}' for x in found)} dB"
        )
        for scale in (1, 0.35):
            call = f"glassplat.then(p => p.measured({{ width: 640, height: 480, frames: {FRAMES}, scale: {scale} }}))"
            seconds = statistics.median(browser.evaluate(call))
            print(f"a picture of 640x480 at {scale:.0%} of its resolution: {seconds:.2f} s in software")


if __name__ == "__main__":
    main()
