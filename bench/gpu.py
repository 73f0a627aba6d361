"""`python -m bench.gpu`: checks the CUDA kernels on this machine's GPU, times them beside gsplat, and trains `planar`.

Within ten minutes. gsplat compiles itself when it is first called; `pip install gsplat==1.5.3`, or go without.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.gpu_roofline import Peaks, backward_demand, counts_of, forward_demand
from bench.gpu_training import training
from bench.kernels import backward, batch_of, raw_of, visited_pixels
from bench.methods import frame_work, step_work, view_of
from bench.scene import bench_camera, bench_scene
from bench.timing import Work, interleaved_seconds, paired_ratio
from glassplat.data.dataset import View
from glassplat.files.markdown_table import Table
from glassplat.kernels.bin_tiles import bin_tiles
from glassplat.kernels.composite import composite
from glassplat.kernels.devices import cuda_problem, kernels_for
from glassplat.kernels.photometric import photometric
from glassplat.kernels.project import project
from glassplat.kernels.splats import Splats, TileBins
from glassplat.render.planar import Planar
from glassplat.render.rasterize import joined_splats
from glassplat.render.splat import Splat
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.splat_recipe import SplatRecipe

Bound = Callable[[Peaks], float]
ROOT = Path(__file__).parent.parent
WIDTH, HEIGHT, COUNT = 960, 720, 560_000
CHECKS = ["tests/kernels/cuda/test_parity.py", "tests/kernels/cuda/test_on_a_gpu.py"]
PARITY = ["-m", "pytest", "-q", "-p", "no:cacheprovider", *CHECKS]
DATA, ITERATIONS = ROOT / "glassplat" / "demo_scene", 7000
REPEATS = 15


def main() -> int:
    """Checks, measures and prints; 1 where there is no GPU or a kernel is wrong."""
    parser = argparse.ArgumentParser(prog="python -m bench.gpu", description=__doc__)
    parser.add_argument("--count", type=int, default=COUNT, help="Gaussians of the timings")
    parser.add_argument("--data", type=Path, default=DATA, help="capture to train on; the bundled showcase by default")
    parser.add_argument(
        "--iterations", type=int, default=ITERATIONS, help="length of the training run; 0 trains nothing"
    )
    parser.add_argument("--cpu-run", type=Path, help="folder of the same run on the CPU, evaluated, to compare with")
    arguments = parser.parse_args()
    problem = cuda_problem()
    if problem is not None:
        print(f"no GPU to measure: {problem}", file=sys.stderr)
        return 1
    print(f"Machine: {torch.cuda.get_device_name()}, torch {torch.__version__}, CUDA {torch.version.cuda}.\n")
    if subprocess.run([sys.executable, *PARITY], cwd=ROOT, check=False).returncode:
        print("the kernels disagree with their twins; no times are worth taking", file=sys.stderr)
        return 1
    print(measured(arguments.count).markdown())
    print(kernel_times(arguments.count).markdown())
    if arguments.iterations:
        with tempfile.TemporaryDirectory() as folder:
            output, cpu_run = Path(folder) / "planar", arguments.cpu_run
            print(training(arguments.data, arguments.iterations, output, cpu_run=cpu_run).markdown())
    return 0


def measured(count: int) -> Table:
    """Frames, gradients and steps of both methods, and gsplat's."""
    camera = bench_camera(WIDTH, HEIGHT).to("cuda")
    scene = bench_scene(count, 1, 0.5, camera.to("cpu")).to("cuda")
    view, recipe = view_of(camera), PlanarRecipe()
    works: dict[str, Work] = {
        "splat frame": frame_work(scene, Splat(depth=False), camera),
        "splat frame and gradients": gradient_work(scene, camera),
        "splat backward": backward_work(scene, camera),
        "planar frame": frame_work(scene, Planar(), camera),
        "splat step": step_work(scene, SplatRecipe().stages(0)[0], view),
        "planar step": step_work(scene, recipe.stages(0)[2], view),
    }
    theirs = gsplat_works(scene, view) if importlib.util.find_spec("gsplat") else {}
    partners = {
        "splat frame": "gsplat frame",
        "planar frame": "gsplat frame",
        "splat frame and gradients": "gsplat frame and gradients",
        "splat backward": "gsplat backward",
        "splat step": "gsplat step",
    }
    started = time.perf_counter()
    for work in works.values():
        work()
    torch.cuda.synchronize()
    note = (
        f"First use of all kernels took {time.perf_counter() - started:.1f} s, compilation included where the disk had "
    )
    note += "none. Memory is the most that torch held beyond the scene and what came before. "
    note += "Ratios are medians of ratios taken round by round." if theirs else "gsplat is not installed."
    seconds = interleaved_seconds({name: timed(work) for name, work in (works | theirs).items()}, REPEATS)
    table = Table(
        f"On a GPU: {count:,} primary Gaussians, SH 3, {WIDTH}x{HEIGHT}, one pane over half of the image",
        ("what", "ms", "gsplat, ms", "gsplat : ours", "memory, MiB", "gsplat memory, MiB"),
        note,
    )
    for name, work in works.items():
        partner = partners.get(name) if theirs else None
        table.add(name, milliseconds(seconds, name), *beside(seconds, name, partner), peak(work),
                  peak(theirs[partner]) if partner else "")  # fmt: skip
    return table


def beside(seconds: Mapping[str, list[float]], name: str, partner: str | None) -> tuple[object, object]:
    """The other's milliseconds and how many times ours they are; nothing where there is no other."""
    if partner is None:
        return "", ""
    return milliseconds(seconds, partner), paired_ratio(seconds, partner, name)


def milliseconds(seconds: Mapping[str, list[float]], name: str) -> float:
    """Median milliseconds."""
    return 1e3 * statistics.median(seconds[name])


def timed(work: Work) -> Work:
    """The work, until the GPU is done with it."""

    def until_done() -> None:
        work()
        torch.cuda.synchronize()

    return until_done


def peak(work: Work) -> int:
    """Most memory that torch held during the work beyond what it held before, in MiB."""
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    work()
    torch.cuda.synchronize()
    return int((torch.cuda.max_memory_allocated() - before) / 2**20)


def trainable(scene: Scene, camera: Camera) -> tuple[Tensor, list[Tensor]]:
    """A frame's colours [H, W, 3], and the leaves that they depend on."""
    leaves = {name: tensor.detach().requires_grad_() for name, tensor in scene.primary.tensors().items()}
    frame = Splat(depth=False)(Scene(scene.primary.with_tensors(leaves), scene.extent), camera)
    return frame.rgb, [leaf for name, leaf in leaves.items() if name != "log_intensity"]


def gradient_work(scene: Scene, camera: Camera) -> Work:
    """One frame and the gradients of all raw Gaussian tensors."""

    def work() -> None:
        image, leaves = trainable(scene, camera)
        torch.autograd.grad(image.sum(), leaves, allow_unused=True)

    return work


def backward_work(scene: Scene, camera: Camera) -> Work:
    """The gradients alone, of a frame that is there."""
    image, leaves = trainable(scene, camera)
    ones = torch.ones_like(image)
    return lambda: torch.autograd.grad([image], leaves, [ones], retain_graph=True, allow_unused=True)


def gsplat_works(scene: Scene, view: View) -> dict[str, Work]:
    """The same by gsplat; activations included, as in ours. Its step has our L1 and SSIM, and torch's fused Adam."""
    rasterization = importlib.import_module("gsplat").rasterization
    gaussians, camera = scene.primary, view.camera
    names = ("means", "quats", "log_scales", "logit_opacities", "sh")
    matrix = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], device="cuda")

    def render(tensors: list[Tensor]) -> Tensor:
        means, quats, log_scales, logit_opacities, sh = tensors
        image: Tensor = rasterization(
            means, quats, log_scales.exp(), logit_opacities.sigmoid(), sh, camera.cam_from_world[None], matrix[None],
            camera.width, camera.height, sh_degree=gaussians.active_sh_degree, near_plane=0.03, packed=False,
        )[0]  # fmt: skip
        return image

    def fresh() -> list[Tensor]:
        return [getattr(gaussians, name).detach().clone().requires_grad_() for name in names]

    def frame() -> None:
        with torch.no_grad():
            render([getattr(gaussians, name) for name in names])

    def gradients() -> None:
        leaves = fresh()
        torch.autograd.grad(render(leaves).sum(), leaves)

    kept = fresh()
    image = render(kept)
    ones = torch.ones_like(image)
    parameters = fresh()
    photo = (torch.rand(camera.height, camera.width, 3, device="cuda") * 255).to(torch.uint8)
    optimizer = torch.optim.Adam(parameters, lr=1e-6, fused=True)

    def step() -> None:
        optimizer.zero_grad()
        l1, ssim = photometric(render(parameters)[0], photo)
        loss = 0.8 * l1 + 0.2 * (1 - ssim)
        loss.backward()
        optimizer.step()

    return {
        "gsplat frame": frame,
        "gsplat frame and gradients": gradients,
        "gsplat backward": lambda: torch.autograd.grad([image], kept, [ones], retain_graph=True),
        "gsplat step": step,
    }


def kernel_times(count: int) -> Table:
    """Milliseconds of each operation, forward and backward."""
    # Imported where there is a GPU, because it needs numba-cuda.
    from bench.gpu_peaks import measured_peaks

    camera = bench_camera(WIDTH, HEIGHT)
    scene = bench_scene(count, 0, 0.0, camera).to("cuda")
    raw, batch = raw_of(scene.primary, trainable=True), batch_of(camera.to("cuda"))
    projected = project(raw, batch, sh_degree=3, near=0.03)
    splats = joined_splats(type(projected)(*(tensor.detach() for tensor in projected)))
    bins = bin_tiles(splats, WIDTH, HEIGHT)
    leaves: Any = [tensor.clone().requires_grad_() for tensor in (*splats[:3], projected.colors.detach())]
    blended = composite(splats._replace(means2d=leaves[0], conics=leaves[1], opacities=leaves[2]), leaves[3], bins)
    picture = torch.rand(HEIGHT, WIDTH, 3, device="cuda")
    photo = (torch.rand(HEIGHT, WIDTH, 3, device="cuda") * 255).to(torch.uint8)
    image = picture.clone().requires_grad_()
    means = list(photometric(image, photo))
    weights = [torch.rand_like(tensor) for tensor in projected[:5]]
    works: dict[str, Work] = {
        "project forward": lambda: project(raw, batch, sh_degree=3, near=0.03),
        "project backward": backward(list(projected[:5]), weights, list(raw)),
        "bin_tiles": lambda: bin_tiles(splats, WIDTH, HEIGHT),
        "composite forward": lambda: composite(splats, leaves[3].detach(), bins),
        "composite backward": backward([blended.image], [picture[None]], leaves),
        "photometric forward": lambda: photometric(picture, photo),
        "photometric backward": backward(means, [torch.ones_like(means[0])] * 2, [image]),
    }
    evaluations = visited_pixels(type(splats)(*(t.cpu() for t in splats)), bins_on_cpu(bins))
    seconds = interleaved_seconds({name: timed(work) for name, work in works.items()}, REPEATS)
    peaks, least = measured_peaks(), least_seconds(splats, leaves[3].detach(), bins, evaluations)
    table = Table(
        "Operations", ("operation", "ms", "ms at the peaks", "share of the roofline"),
        f"{len(bins.pair_splats):,} (tile, splat) pairs, {evaluations:,} pixel-Gaussian evaluations if none stopped. "
        f"Measured peaks: {peaks.multiply_adds / 1e12:.1f} T multiply-adds/s, {peaks.bytes / 1e9:.0f} GB/s.",
    )  # fmt: skip
    for name in works:
        bound = least[name](peaks) if name in least else None
        shown = ("", "") if bound is None else (1e3 * bound, f"{bound / statistics.median(seconds[name]):.0%}")
        table.add(name, milliseconds(seconds, name), *shown)
    return table


def least_seconds(splats: Splats, channels: Tensor, bins: TileBins, evaluations: int) -> dict[str, Bound]:
    """What bounds both passes of `composite`, from what a forward pass counted."""
    forward = kernels_for("composite", channels.device).composite
    marks, count = channels.new_zeros(1, 0), channels.shape[1]
    options: dict[str, Any] = {"marks": marks, "num_primary": count, "deviation": None, "needs_gradients": True}
    saved = forward(splats, channels, bins, **options)[-1]
    counts = counts_of(saved, evaluations, len(bins.pair_splats), channels.shape[2])
    return {
        "composite forward": forward_demand(counts._replace(buckets=0)).seconds_at,
        "composite backward": backward_demand(counts).seconds_at,
    }


def bins_on_cpu(bins: Any) -> Any:
    """The same bins on the CPU."""
    return type(bins)(*(field.cpu() if isinstance(field, Tensor) else field for field in bins))


if __name__ == "__main__":
    sys.exit(main())
