"""What happens when reflections begin: planes, glass, mirrors, and what the panes will reflect."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

from torch import Tensor

from glassplat.data.dataset import Dataset
from glassplat.densify.edit import append, apply_edit, keep
from glassplat.init.glass import glass_gaussians
from glassplat.init.material import mirror_labels, mirrored_coverage
from glassplat.init.planes import PlaneFit, fit_planes, with_mirrors
from glassplat.init.points import gaussians_from_points
from glassplat.init.virtual_scene import virtual_points
from glassplat.scene.camera import Camera
from glassplat.scene.mirrored import mirrored_gaussians
from glassplat.scene.plane import Planes
from glassplat.train.state import TrainState

log = logging.getLogger("glassplat.train")

LEAST_COVERAGE = 0.5
"""Where the panes mirror less than this share of what they could, the photographs do not show the room directly."""


@dataclass(frozen=True)
class PlaneEntry:
    """Fits the planes and places the glass when reflections begin (Appendix A).

    Attributes:
        fit: how planes are found.
        glass_count: glass Gaussians on each pane.
        seed: of the glass Gaussians' places.
        detect_mirrors: tell mirrors from glass, unless `fit` names the mirrors.
        fixed_mirrors: mirrors keep their reflectance, and what is behind them moves to their front; if not, they only
            start at that reflectance.
        seed_reflections: start what no photograph shows directly from the virtual points behind the panes.
    """

    fit: PlaneFit
    glass_count: int
    seed: int
    detect_mirrors: bool = True
    fixed_mirrors: bool = True
    seed_reflections: bool = True

    def __call__(self, state: TrainState, dataset: Dataset) -> None:
        """Edits `state`."""
        means, extent = state.scene.primary.means, state.scene.extent
        planes = fit_planes(means, annotations_of(dataset), extent=extent, options=self.fit)
        glass = glass_gaussians(planes, count=self.glass_count, seed=self.seed)
        scene = replace(state.scene, planes=planes, glass=glass)
        if self.detect_mirrors and not self.fit.mirror_labels:
            found = mirror_labels(scene, dataset.train)
            log.info("mirrors among the panes: %s", ", ".join(map(str, found)) or "none")
            planes = with_mirrors(planes, found, self.fit.mirror_reflectance)
        if not self.fixed_mirrors:
            planes = replace(planes, mirrors=())
        state.scene = replace(scene, planes=planes)
        state.statistics.clear()
        for row, label in enumerate(planes.labels):
            if label in planes.mirrors:
                turn_virtual_scene_round(state, dataset, planes.select([row]))
            elif self.seed_reflections:
                seed_reflection(state, dataset, planes.select([row]))


def annotations_of(dataset: Dataset) -> list[tuple[Camera, Tensor]]:
    """Cameras and pane labels [H, W] of the annotated training views."""
    return [(view.camera, view.pane_labels) for view in dataset.train if view.pane_labels is not None]


def turn_virtual_scene_round(state: TrainState, dataset: Dataset, mirror: Planes) -> None:
    """Moves what the first stage built behind a mirror to where it really is, in front of it."""
    primary, moments = state.scene.primary, state.optimizer.moments
    virtual = virtual_points(primary.means, mirror, [view.camera for view in dataset.train])
    if not bool(virtual.any()):
        return
    turned = mirrored_gaussians(primary.select(virtual), mirror.centers[0], mirror.normals[0])
    primary, moments = apply_edit(primary, moments, keep(~virtual))
    primary, state.optimizer.moments = append(primary, moments, turned)
    state.scene = replace(state.scene, primary=primary)
    log.info("%d Gaussians behind mirror %d moved to its front", int(virtual.sum()), mirror.labels[0])


def seed_reflection(state: TrainState, dataset: Dataset, pane: Planes) -> None:
    """Adds the mirror images of the measured points behind a pane, if the pane has hardly anything to reflect.

    Structure from motion places points on reflected things where they seem to be, behind the pane. In a capture from
    the front these are the only trace of what is reflected; the true points behind the pane, mirrored along, are
    wrong and fade.
    """
    cameras = [view.camera for view in dataset.train]
    # The coverage is rendered over all views, so it comes last.
    if not dataset.measured_points or mirrored_coverage(state.scene, pane, cameras) >= LEAST_COVERAGE:
        return
    points = dataset.points
    device = pane.centers.device
    virtual = virtual_points(points.positions.to(device), pane, cameras).cpu()
    if not bool(virtual.any()):
        return
    behind = replace(points, positions=points.positions[virtual], colors=points.colors[virtual])
    primary = state.scene.primary
    seeds = gaussians_from_points(behind, sh_degree=primary.max_sh_degree).to(device)
    seeds = replace(seeds, active_sh_degree=primary.active_sh_degree)
    seeds = mirrored_gaussians(seeds, pane.centers[0], pane.normals[0])
    primary, state.optimizer.moments = append(primary, state.optimizer.moments, seeds)
    state.scene = replace(state.scene, primary=primary)
    log.info("pane %d reflects what no photograph shows: %d points behind it mirrored", pane.labels[0], len(seeds))
