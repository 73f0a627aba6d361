"""Frames, gradients and steps on a GPU, compared with gsplat 1.5.3 if it is installed."""

from __future__ import annotations

import importlib
import importlib.util
import statistics
import time
from collections.abc import Mapping

import torch
from torch import Tensor

from benchmarks.methods import frame_work, step_work, view_of
from benchmarks.scene import bench_camera, bench_scene, mirroring_scene
from benchmarks.table import Table
from benchmarks.timing import Work, interleaved_seconds, paired_ratio
from glassplat.captures.view import View
from glassplat.kernels.photometric import photometric
from glassplat.methods.glossy_recipes import TracedRecipe
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.render.traced import Traced
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene

WIDTH, HEIGHT, REPEATS = 960, 720, 15


def measured(count: int) -> Table:
    """Frames, gradients and steps of both methods and of gsplat."""
    camera = bench_camera(WIDTH, HEIGHT).to("cuda")
    scene = bench_scene(count, 1, 0.5, camera.to("cpu")).to("cuda")
    mirroring = mirroring_scene(count).to("cuda")
    view, recipe = view_of(camera), PlanarRecipe()
    works: dict[str, Work] = {
        "splat frame": frame_work(scene, Splat(depth=False), camera),
        "splat frame and gradients": gradient_work(scene, camera),
        "splat backward": backward_work(scene, camera),
        "planar frame": frame_work(scene, Planar(), camera),
        "splat step": step_work(scene, SplatRecipe().stages(0)[0], view),
        "planar step": step_work(scene, recipe.stages(0)[2], view),
        "traced frame": frame_work(mirroring, Traced(), camera),
        "traced step": step_work(mirroring, TracedRecipe().stages(0)[-1], view),
    }
    theirs, missing = gsplat_if_usable(scene, view)
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
    note = f"First use of all kernels took {time.perf_counter() - started:.1f} s, including compilation if the cache "
    note += "was empty. Memory is the peak of torch beyond the scene and earlier allocations. "
    note += missing or "Ratios are medians of ratios taken round by round."
    seconds = interleaved_seconds({name: timed(work) for name, work in (works | theirs).items()}, REPEATS)
    table = Table(
        f"On a GPU: {count:,} primary Gaussians, SH 3, {WIDTH}x{HEIGHT}, one pane over half of the image, or all "
        "Gaussians reflecting as many others",
        ("what", "ms", "gsplat, ms", "gsplat : ours", "memory, MiB", "gsplat memory, MiB"),
        note,
    )
    for name, work in works.items():
        partner = partners.get(name) if theirs else None
        own, memory = milliseconds(seconds, name), peak(work)
        if partner is None:
            table.add(name, own, "", "", memory, "")
            continue
        ratio = paired_ratio(seconds, partner, name)
        table.add(name, own, milliseconds(seconds, partner), ratio, memory, peak(theirs[partner]))
    return table


def milliseconds(seconds: Mapping[str, list[float]], name: str) -> float:
    """Median milliseconds."""
    return 1e3 * statistics.median(seconds[name])


def timed(work: Work) -> Work:
    """The work followed by a synchronisation with the GPU."""

    def until_done() -> None:
        work()
        torch.cuda.synchronize()

    return until_done


def peak(work: Work) -> int:
    """Peak memory that torch allocated during the work, beyond what was allocated before, in MiB."""
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    work()
    torch.cuda.synchronize()
    return int((torch.cuda.max_memory_allocated() - before) / 2**20)


def trainable(scene: Scene, camera: Camera) -> tuple[Tensor, list[Tensor]]:
    """Colours of a frame [H, W, 3], and the leaf tensors that they depend on."""
    leaves = {name: tensor.detach().requires_grad_() for name, tensor in scene.primary.tensors().items()}
    frame = Splat(depth=False)(Scene(scene.primary.with_tensors(leaves), scene.extent), camera)
    return frame.rgb, [leaf for name, leaf in leaves.items() if name != "log_intensity"]


def gradient_work(scene: Scene, camera: Camera) -> Work:
    """Renders one frame and computes the gradients of all raw Gaussian tensors."""

    def work() -> None:
        image, leaves = trainable(scene, camera)
        torch.autograd.grad(image.sum(), leaves, allow_unused=True)

    return work


def backward_work(scene: Scene, camera: Camera) -> Work:
    """Computes only the gradients of a rendered frame."""
    image, leaves = trainable(scene, camera)
    ones = torch.ones_like(image)
    return lambda: torch.autograd.grad([image], leaves, [ones], retain_graph=True, allow_unused=True)


def gsplat_if_usable(scene: Scene, view: View) -> tuple[dict[str, Work], str]:
    """The work in gsplat and "", or no work and the reason: gsplat may be installed without having been built."""
    if importlib.util.find_spec("gsplat") is None:
        return {}, "gsplat is not installed."
    try:
        return gsplat_works(scene, view), ""
    except (ImportError, OSError, RuntimeError) as error:
        return {}, f"gsplat cannot be used: {error}."


def gsplat_works(scene: Scene, view: View) -> dict[str, Work]:
    """The same work in gsplat, including activations. Its step uses our L1 and SSIM, and the fused Adam of torch."""
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
