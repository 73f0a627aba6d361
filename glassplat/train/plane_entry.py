"""What happens when reflections begin: planes, glass, mirrors, and what the panes will reflect."""

from __future__ import annotations

import logging
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from glassplat.data.dataset import Dataset
from glassplat.densify.edit import append, apply_edit, keep
from glassplat.init.glass import glass_gaussians
from glassplat.init.material import mirrored_coverage, mirrors_among, pane_pixels
from glassplat.init.plane_options import PlaneFit
from glassplat.init.planes import fit_planes, with_mirrors
from glassplat.init.points import gaussians_from_points
from glassplat.init.virtual_scene import virtual_points
from glassplat.scene.camera import Camera
from glassplat.scene.coplanar import coplanar_groups
from glassplat.scene.mirrored import mirrored_gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.scene import Scene
from glassplat.train.messages import Working
from glassplat.train.stage import Clock, Work
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
        tint: whether panes may be tinted.
    """

    fit: PlaneFit
    glass_count: int
    seed: int
    detect_mirrors: bool = True
    fixed_mirrors: bool = True
    seed_reflections: bool = True
    tint: bool = False

    def __call__(self, state: TrainState, dataset: Dataset) -> Work:
        """Edits `state`, and tells how far it is."""
        yield Working("fitting planes to the masks", 0, 1)
        planes = fitted_planes(dataset, state.scene.primary.means, self.fit)
        glass = glass_gaussians(planes, count=self.glass_count, seed=self.seed)
        scene = replace(state.scene, planes=planes, glass=glass)
        if self.detect_mirrors and not self.fit.mirror_labels:
            planes = yield from self._with_mirrors_found(scene, dataset)
        if not self.fixed_mirrors:
            planes = replace(planes, mirrors=())
        state.scene = replace(scene, planes=planes.that_may_tint() if self.tint else planes)
        state.statistics.clear()
        for mirrors in surfaces(planes, mirrors=True):
            yield Working(f"moving what was built behind {named(mirrors, 'mirror')}", 0, 1)
            turn_virtual_scene_round(state, dataset, mirrors)
        for panes in surfaces(planes, mirrors=False) if self.seed_reflections else ():
            yield from seed_reflection(state, dataset, panes)
        return True

    def _with_mirrors_found(self, scene: Scene, dataset: Dataset) -> Generator[Working, None, Planes]:
        """The scene's planes, with those as mirrors that look like it; of given ones the capture says what they are."""
        given = Planes.empty() if dataset.planes is None else dataset.planes
        told = [label for label in scene.planes.labels if label in given.labels]
        if len(told) == len(scene.planes):
            return scene.planes
        found = yield from mirrors_found(scene, dataset)
        mirrors = tuple(label for label in found if label not in told)
        log.info("mirrors among the panes: %s", ", ".join(map(str, mirrors)) or "none")
        return with_mirrors(scene.planes, (*given.mirrors, *mirrors), self.fit.mirror_reflectance)


def glass_only_darkens(state: TrainState, clock: Clock, visible: Tensor | None) -> None:
    """Takes logarithms of transmittances that a step has led above 0 back to it: glass adds no light."""
    logarithms = state.scene.planes.log_transmittances
    if logarithms is not None:
        logarithms.detach().clamp_(max=0)


def fitted_planes(dataset: Dataset, centers: Tensor | None, fit: PlaneFit) -> Planes:
    """The planes of all panes: those that the capture gives, and those that only its masks name, fitted to them.

    Args:
        dataset: the capture.
        centers: [N, 3] those of Gaussians; None fits to the capture's own points.
        fit: how planes are found.

    Raises:
        PlaneFitError: the masks do not do.
    """
    given = Planes.empty() if dataset.planes is None else _as_given(dataset.planes, fit)
    labels = [label for label in dataset.pane_labels if label not in given.labels]
    if not labels and len(given):
        return given if centers is None else given.to(centers.device)
    shown = [(view.name, view.camera, view.pane_labels) for view in dataset.train if view.pane_labels is not None]
    points = dataset.points.positions
    fitted = fit_planes(
        points if centers is None else centers,
        [(camera, labels) for _, camera, labels in shown],
        extent=dataset.extent,
        measured=points if dataset.measured_points and centers is not None else None,
        names=[name for name, _, _ in shown],
        labels=labels or None,
        options=fit,
    )
    return fitted if not len(given) else given.to(fitted.centers.device).joined(fitted)


def _as_given(planes: Planes, fit: PlaneFit) -> Planes:
    """Given rectangles with the margin that fitted ones get, and mirrors as mirrors."""
    mirrors = tuple(dict.fromkeys((*planes.mirrors, *fit.mirror_labels)))
    log.info("panes %s lie where the capture's planes.json says", ", ".join(map(str, planes.labels)))
    return with_mirrors(replace(planes, half_sizes=fit.margin * planes.half_sizes), mirrors, fit.mirror_reflectance)


def mirrors_found(scene: Scene, dataset: Dataset) -> Generator[Working, None, tuple[int, ...]]:
    """Labels of the panes that look like mirrors in the annotated views."""
    annotated = [view for view in dataset.train if view.is_annotated]
    pairs = []
    for done, view in enumerate(annotated):
        yield Working("telling mirrors from glass", done, len(annotated))
        pairs.append(pane_pixels(scene, view))
    return mirrors_among(scene.planes.labels, pairs)


def surfaces(planes: Planes, *, mirrors: bool) -> list[Planes]:
    """The mirrors, or the panes that are none, those in one plane together.

    Behind one pane of a glass front lies what is mirrored in it and its neighbours: most views show it through these.
    """
    rows = [row for row, label in enumerate(planes.labels) if (label in planes.mirrors) == mirrors]
    return [planes.select(group) for group in coplanar_groups(planes, rows)]


def named(panes: Planes, kind: str) -> str:
    """What messages call panes: "pane 2", "panes 2, 3"."""
    labels = ", ".join(map(str, sorted(panes.labels)))
    return f"{kind}s {labels}" if len(panes) > 1 else f"{kind} {labels}"


def reflects_little(scene: Scene, panes: Planes, cameras: Sequence[Camera]) -> Work:
    """Whether Gaussians cover hardly anything of what panes could mirror; False where no view shows any."""
    covered, whole = 0.0, 0
    for done, camera in enumerate(cameras):
        yield Working(f"looking for what {named(panes, 'pane')} can mirror", done, len(cameras))
        of_view, pixels = mirrored_coverage(scene, panes, camera)
        covered, whole = covered + of_view, whole + pixels
    return covered < LEAST_COVERAGE * whole


def turn_virtual_scene_round(state: TrainState, dataset: Dataset, mirrors: Planes) -> None:
    """Moves what the first stage built behind a mirror, or several in one plane, to where it really is, in front."""
    primary, moments = state.scene.primary, state.optimizer.moments
    virtual = virtual_points(primary.means, mirrors, [view.camera for view in dataset.train])
    if not bool(virtual.any()):
        return
    turned = mirrored_gaussians(primary.select(virtual), mirrors.centers[0], mirrors.normals[0])
    primary, moments = apply_edit(primary, moments, keep(~virtual))
    primary, state.optimizer.moments = append(primary, moments, turned)
    state.scene = replace(state.scene, primary=primary)
    log.info("%d Gaussians behind %s moved to the front", int(virtual.sum()), named(mirrors, "mirror"))


def seed_reflection(state: TrainState, dataset: Dataset, panes: Planes) -> Work:
    """Adds the mirror images of the measured points behind panes in one plane, if these hardly have a thing to mirror.

    Structure from motion places points on reflected things where they seem to be, behind the pane. In a capture from
    the front these are the only trace of what is reflected; the true points behind the pane, mirrored along, are
    wrong and fade.
    """
    cameras = [view.camera for view in dataset.train]
    # The coverage is rendered over all views, so it comes last.
    if not dataset.measured_points or not (yield from reflects_little(state.scene, panes, cameras)):
        return False
    points = dataset.points
    device = panes.centers.device
    virtual = virtual_points(points.positions.to(device), panes, cameras).cpu()
    if not bool(virtual.any()):
        return False
    behind = replace(points, positions=points.positions[virtual], colors=points.colors[virtual])
    primary = state.scene.primary
    seeds = gaussians_from_points(behind, sh_degree=primary.max_sh_degree).to(device)
    seeds = replace(seeds, active_sh_degree=primary.active_sh_degree)
    seeds = mirrored_gaussians(seeds, panes.centers[0], panes.normals[0])
    primary, state.optimizer.moments = append(primary, state.optimizer.moments, seeds)
    state.scene = replace(state.scene, primary=primary)
    log.info("no photograph shows what is mirrored by %s: %d points behind mirrored", named(panes, "pane"), len(seeds))
    return True
