"""Memory of a training whose photographs do not fit, and the cost of reading them again.

    python -m benchmarks.photographs PHOTOS --count 3000 --memory 3 --seconds 240
    python -m benchmarks.photographs PHOTOS --count 300 --memory 0.1 --downscale 2 --distortion 0.05 --seconds 240

The photographs of a folder are repeated by links in a temporary folder, with camera positions on a circle, so the
result is meaningless. The first half of the time, in which memory fills, is excluded from the shares.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import resource
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from glassplat.captures.dataset import load_dataset, read_photographs_in_background
from glassplat.captures.view import DiskCache, PixelCache, PointCloud, Reader, View
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.training.loop import train
from glassplat.training.messages import StepDone
from glassplat.training.stage import TrainState

READ = 10
POINTS = 5_000
"""A small number, so that steps are as short as possible."""


class Waited(PixelCache):
    """Photograph memory that adds up the seconds for which the main thread, which trains, has waited."""

    seconds = 0.0

    def get(self, reader: Reader) -> Tensor:
        """Returns the pixels, as in the base class."""
        begun = time.perf_counter()
        found = super().get(reader)
        if threading.current_thread() is threading.main_thread():
            self.seconds += time.perf_counter() - begun
        return found


def resident_gigabytes() -> float:
    """Resident memory of the process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e9


def write_capture(photographs: list[Path], count: int, distortion: float, folder: Path) -> None:
    """Writes a capture of `count` photographs, whose cameras on a circle face its centre."""
    (folder / "images").mkdir()
    frames = []
    for number, source in zip(range(count), itertools.cycle(photographs), strict=False):
        name = f"images/{number:05d}{source.suffix}"
        (folder / name).symlink_to(source.resolve())
        angle = 2 * math.pi * number / count
        turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, turn @ (0, 0, 4)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    width, height = Image.open(photographs[0]).size
    lens = {"fl_x": width, "fl_y": width, "cx": width / 2, "cy": height / 2, "w": width, "h": height, "k1": distortion}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))


def read_seconds(views: tuple[View, ...], folder: Path) -> tuple[float, float]:
    """CPU seconds per photograph: reading its file, and reading the undistorted, reduced copy from the spool."""
    spool, begun = DiskCache(folder), time.thread_time()
    pixels = [view.read_photo() for view in views]
    read = time.thread_time()
    for view, photo in zip(views, pixels, strict=True):
        spool.put(view.read_photo, photo)
    put = time.thread_time()
    for view in views:
        spool.get(view.read_photo)
    again = time.thread_time() - put
    spool.close()
    return (read - begun) / len(views), again / len(views)


def measure(folder: Path, memory: float, downscale: float, seconds: float) -> None:
    """Trains for the given seconds, and prints ten progress lines and the final shares."""
    dataset = load_dataset(folder, downscale=downscale)
    camera = dataset.train[0].camera
    known = Waited(memory * 1e9, largest=camera.width * camera.height)
    train_views, test_views = (tuple(replace(v, memory=known) for v in vs) for vs in (dataset.train, dataset.test))
    points = PointCloud(dataset.points.positions[:POINTS], dataset.points.colors[:POINTS])
    dataset = replace(dataset, train=train_views, test=test_views, points=points)
    print(f"{len(dataset.train)} photographs take {dataset.photograph_bytes / 1e9:.1f} GB, {memory:g} GB may stay")
    recipe = SplatRecipe(sh_degree=1)
    state = TrainState(recipe.initialise(dataset), seed=0)
    begun, told = time.perf_counter(), 0
    first: tuple[int, float, float, float] | None = None
    with known.cache_on_disk(folder), read_photographs_in_background(dataset) as check:
        for message in train(recipe.stages(0), dataset, state, 1_000_000):
            check()
            if not isinstance(message, StepDone):
                continue
            passed = time.perf_counter() - begun
            if first is None and passed > seconds / 2:
                first = message.step, passed, known.seconds, time.thread_time()
            if passed > (told + 1) * seconds / 10:
                told += 1
                print(f"{passed:5.0f} s, step {message.step}: {resident_gigabytes():.2f} GB", flush=True)
            if passed > seconds:
                break
    assert first is not None
    step, since, waited, computed = first
    steps, wall = message.step - step, passed - since
    share = (known.seconds - waited) / wall
    print(f"{wall / steps * 1e3:.0f} ms per step, {100 * share:.2f} % of it waiting for photographs")
    computed = time.thread_time() - computed
    reading, again = read_seconds(dataset.train[:READ], folder)
    print(
        f"CPU time: {computed / steps * 1e3:.0f} ms per step, {reading * 1e3:.0f} ms to read a photograph, "
        f"{again * 1e3:.1f} ms to read its undistorted, reduced copy again"
    )
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")


def main() -> None:
    """Measures one capture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("photographs", type=Path, help="folder of photographs of one size, or of several such folders")
    parser.add_argument("--count", type=int, default=3000, help="photographs of the capture")
    parser.add_argument("--memory", type=float, default=3.0, help="gigabytes of photographs that may stay in memory")
    parser.add_argument("--downscale", type=float, default=1.0, help="factor by which photographs are reduced")
    parser.add_argument("--distortion", type=float, default=0.0, help="distortion k1 of the lens, which is removed")
    parser.add_argument("--seconds", type=float, default=240.0, help="duration of the training")
    arguments = parser.parse_args()
    found = sorted(path for path in arguments.photographs.rglob("*") if path.suffix.lower() in (".jpg", ".png"))
    with tempfile.TemporaryDirectory() as folder:
        write_capture(found, arguments.count, arguments.distortion, Path(folder))
        measure(Path(folder), arguments.memory, arguments.downscale, arguments.seconds)


if __name__ == "__main__":
    main()
