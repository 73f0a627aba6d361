"""What `glassplat info` says of scenes, once PyTorch is there to read them."""

from __future__ import annotations

from pathlib import Path

import torch

from glassplat.commands.inspecting.finding import Finding
from glassplat.data.errors import InputError
from glassplat.files.json_text import read_json
from glassplat.files.scene_folder import read_scene
from glassplat.files.splat_files import read_splats
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.train.run_directory import RunDirectory

MEASURES = {"psnr": "PSNR", "pane_psnr": "PSNR over panes", "ssim": "SSIM", "lpips": "LPIPS"}
MANY_FAINT = 0.5
FAINT = 0.01


def splats_part(path: Path) -> Finding:
    """What a file of Gaussians holds.

    Raises:
        InputError: it cannot be read.
    """
    try:
        gaussians = read_splats(path)
    except ValueError as error:
        raise InputError(str(error)) from error
    finding = Finding()
    _look_at(gaussians, finding)
    return finding


def trained_part(directory: RunDirectory) -> Finding:
    """What a training has led to so far."""
    finding = Finding()
    try:
        scene, step = directory.latest_scene()
    except InputError as error:
        begun = directory.checkpoint.is_file()
        finding.problems.append("it was interrupted, and goes on with --resume" if begun else str(error))
        finding.next.append(f"the train command that began it, {'with --resume' if begun else 'again'}")
        return finding
    finding.facts["trained to"] = step
    _describe_scene(scene, finding)
    _describe_results(directory, finding)
    return finding


def scene_part(path: Path) -> Finding:
    """What the scene in a folder consists of.

    Raises:
        InputError: it cannot be read.
    """
    try:
        scene = read_scene(path)
    except (ValueError, FileNotFoundError) as error:
        raise InputError(str(error)) from error
    finding = Finding()
    _describe_scene(scene, finding)
    return finding


def _describe_scene(scene: Scene, finding: Finding) -> None:
    _look_at(scene.primary, finding)
    planes = scene.planes
    if len(planes):
        told = (
            f"{label}{' (mirror)' if label in planes.mirrors else f' (R0 {float(reflectance):.3f})'}"
            for label, reflectance in zip(planes.labels, planes.base_reflectances, strict=True)
        )
        finding.facts["panes"] = ", ".join(told)
    if len(scene.photographer):
        finding.facts["photographer"] = f"{len(scene.photographer)} Gaussians, which panes show in photographs only"
    if not scene.environment.is_empty:
        finding.facts["environment"] = f"a cube map of {scene.environment.size} texels a side"


def _look_at(gaussians: Gaussians, finding: Finding) -> None:
    """Number, colours, reach and oddities of Gaussians."""
    finding.facts["Gaussians"] = len(gaussians)
    if not len(gaussians):
        finding.problems.append("it holds no Gaussian")
        return
    finding.facts["degree of harmonics"] = gaussians.max_sh_degree
    finite = torch.isfinite(gaussians.means).all(dim=1)
    if not bool(finite.all()):
        finding.problems.append(f"{int((~finite).sum())} Gaussians have no place that is finite; they are not drawn")
    means = gaussians.means[finite]
    low, high = (torch.quantile(means[:: max(1, len(means) // 100_000)], share, dim=0) for share in (0.02, 0.98))
    spans = " x ".join(f"{float(side):.3g}" for side in high - low)
    finding.facts["size of the middle 96 %"] = f"{spans} world units"
    faint = float((torch.sigmoid(gaussians.logit_opacities) < FAINT).float().mean())
    if faint > MANY_FAINT:
        finding.problems.append(f"{faint:.0%} of the Gaussians are nearly invisible; `glassplat export` can prune them")


def _describe_results(directory: RunDirectory, finding: Finding) -> None:
    path = directory.path
    if not directory.results.is_file():
        finding.next.append(f"glassplat eval {path}    measures it on its test views")
    else:
        try:
            results = read_json(directory.results)
            measures = [f"{label} {results[name]:.3f}" for name, label in MEASURES.items() if results.get(name)]
            finding.facts["measured"] = ", ".join(measures)
        except (ValueError, TypeError, AttributeError):
            finding.problems.append(f"{directory.results} is damaged; evaluate it again")
    finding.next.append(f"glassplat render {path} --layers rgb --output PICTURES")
