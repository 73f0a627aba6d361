"""Similarity of the web page of a run to its renders, and latency and frame rate of the page without a GPU.

python -m tools.page_likeness runs/showcase out/index.html
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from glassplat.captures.dataset import TEST_EVERY
from glassplat.evaluate.metrics import psnr
from glassplat.files.spz import HALF_TURN_X
from glassplat.model.model import Model, load
from glassplat.scene.camera import Camera
from tools.browser import Browser

VIEWS = 5
DRAG_STEPS = 40


def wanted(camera: Camera, layer: str) -> str:
    """JavaScript call that returns the image of a camera."""
    flip = torch.tensor(HALF_TURN_X)
    rotation, position = camera.cam_from_world[:3, :3] * flip, camera.center * flip
    values: dict[str, Any] = {"rotation": rotation.flatten().tolist(), "position": position.tolist()}
    values |= {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    values |= {"layers": [layer, layer]}
    return f"glassplat.then(page => page.picture({json.dumps(values)}))"


def picture(browser: Browser, camera: Camera, layer: str = "rgb") -> torch.Tensor:
    """Image of a layer in the page, [H, W, 3] uint8."""
    return pixels_of(browser.evaluate(wanted(camera, layer)), camera.width, camera.height)


def pixels_of(text: str, width: int, height: int) -> torch.Tensor:
    """Decodes an image returned by the page, as [H, W, 3] uint8."""
    pixels = np.frombuffer(base64.b64decode(text), dtype=np.uint8)
    return torch.from_numpy(pixels.reshape(height, width, 4)[::-1, :, :3].copy())


def likenesses(browser: Browser, model: Model) -> list[float]:
    """PSNR of the page against renders of the model, for some of the test views."""
    cameras = [model.cameras[name] for name in sorted(model.cameras)[::TEST_EVERY]]
    found = []
    for camera in cameras[:: max(1, len(cameras) // VIEWS)][:VIEWS]:
        with torch.no_grad():
            truth = model.renderer(model.scene, camera).rgb
        found.append(psnr(picture(browser, camera), truth.clamp(0, 1)))
    return found


@dataclass(frozen=True)
class Walk:
    """Record of the page during a drag and after its release."""

    moving: list[dict[str, float]]
    """Frames during the drag: `time` in milliseconds, `scale` of the resolution, number of drawn `splats`."""
    resting: list[dict[str, float]]
    """Frames after the release, up to the one at full resolution."""
    seconds: float
    """Duration of the drag."""
    end: float
    """Time of the end of the drag, in milliseconds."""
    processor: float
    """CPU seconds of the browser during the drag."""

    def report(self) -> str:
        """Report of both phases, in two lines."""
        scale = statistics.mean(picture["scale"] for picture in self.moving)
        splats, every = (statistics.mean(p["splats"] for p in ps) for ps in (self.moving, self.resting[-1:]))
        count, first = len(self.moving), self.resting[0]
        return (
            f"moving: {count / self.seconds:.1f} frames per second in software, {self.processor / count:.3f} s of "
            f"CPU time each, at {scale:.0%} of the resolution, {splats / every:.0%} of the Gaussians\n"
            f"at rest: the next frame after {(first['time'] - self.end) / 1000:.2f} s, "
            f"full resolution after {(self.resting[-1]['time'] - self.end) / 1000:.2f} s"
        )


def processor_seconds(process: int) -> float:
    """User and system time of all running descendants of a process."""
    seconds, ticks = 0.0, os.sysconf("SC_CLK_TCK")
    pending, children = [process], _running()
    while pending:
        for child, used in children.get(pending.pop(), []):
            seconds += used / ticks
            pending.append(child)
    return seconds


def _running() -> dict[int, list[tuple[int, int]]]:
    """Children of every process, with the clock ticks that they have used."""
    children: dict[int, list[tuple[int, int]]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # The process has ended.
            continue
        children.setdefault(int(fields[1]), []).append((int(stat.parent.name), int(fields[11]) + int(fields[12])))
    return children


def walked(browser: Browser) -> Walk:
    """Drags the page like a user, stops, and waits for the frame at full resolution."""
    noted = "glassplat.then(({ noted }) => noted)"
    wait = "glassplat.then(({ noted }) => noted.some(({ scale }) => scale === 1))"
    browser.wait(wait, "the first whole picture")
    begin = browser.evaluate("glassplat.then(({ noted }) => { noted.length = 0; return performance.now(); })")
    used = processor_seconds(os.getpid())
    browser.drag([(200, 150), *((200 + 3 * step, 150 + step) for step in range(DRAG_STEPS))], pause=0.02)
    end = browser.evaluate("performance.now()")
    moving, used = browser.evaluate(noted), processor_seconds(os.getpid()) - used
    browser.wait(wait, "the whole picture")
    resting = [picture for picture in browser.evaluate(noted) if picture["time"] > end]
    return Walk([p for p in moving if p["time"] <= end], resting, (end - begin) / 1000, end, used)


def main() -> None:
    """Prints similarity, latency and frame rate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a trained run")
    parser.add_argument("page", type=Path, help="its exported page")
    run, page = vars(parser.parse_args()).values()
    model = load(run, device="cpu")
    with Browser(page, 640, 480) as browser:
        found = likenesses(browser, model)
        print(
            f"{page.stat().st_size / 1e6:.2f} MB, PSNR of {len(found)} views: {', '.join(f'{x:.1f}' for x in found)} dB"
        )
        print(walked(browser).report())


if __name__ == "__main__":
    main()
