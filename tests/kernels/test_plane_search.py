"""The kernels of the search for planes, compared with their definitions in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from glassplat.kernels.plane_search import STEEPEST, Cameras, Edges, Field, follow_edges, sum_mirrored
from glassplat.panes.masks import (
    UNKNOWN_WEIGHT,
    FramedPlanes,
    PaneView,
    agreement_per_view,
    intersect_rays,
    mask_agreement,
    pane_view,
)
from glassplat.panes.objective import edge_matches
from tests.kernels.threads import assert_threads_change_no_bit
from tests.panes.pane_scene import FRONT, SIDE, scene_of

Array = np.ndarray
EYES = [(x, y, -1.0) for x in (-1.2, -0.4, 0.6, 1.2) for y in (0.0, 0.3)]


@pytest.fixture(scope="module")
def views() -> list[PaneView]:
    """Views of a pane occluded by another one; the last is smaller than the others and sees the pane from behind."""
    near = replace(FRONT, center=FRONT.center + np.array([0.5, 0.2, -0.6]), half_sizes=(0.3, 0.2))
    annotations = scene_of([FRONT, near], [*EYES, (0.5, 0.2, 4.5)])
    found = [pane_view(*annotation, 1) for annotation in annotations]
    last = found[-1]
    return [*found[:-1], replace(last, mask=last.mask[:200], hidden=last.hidden[:200], distance=last.distance[:200])]


@pytest.fixture(scope="module")
def planes() -> FramedPlanes:
    """The pane's plane, planes near it, arbitrary planes, and planes with a camera on or behind them."""
    rng = np.random.default_rng(0)
    normals = np.concatenate([np.tile(FRONT.normal, (30, 1)) + 0.05 * rng.standard_normal((30, 3)), SIDE.normal[None]])
    normals = np.concatenate([FRONT.normal[None], normals, rng.standard_normal((60, 3)), [[0, 0, 1.0], [0, 0, 1.0]]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = normals @ FRONT.center + 0.2 * rng.standard_normal(len(normals))
    offsets[0], offsets[-2:] = FRONT.normal @ FRONT.center, (-1.0, -1.5)
    return FramedPlanes(normals, offsets, np.zeros(len(normals)))


def pixel_and_frame(planes: FramedPlanes, view: PaneView, points: Array, outward: Array) -> tuple[Array, Array]:
    """Size on the plane of a pixel across an edge, and of the part hidden by a frame of height one; [H, P] each."""
    height = np.abs(planes.normals @ view.center - planes.offsets)[:, None]
    beyond = np.einsum("hpd,hpd->hp", outward, view.center - points)
    steep = beyond / np.maximum(height, 1e-100)
    depth = np.abs(points @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3])
    return depth * np.sqrt(1 + steep**2) / np.sqrt(view.intrinsics[:2].prod()), np.clip(steep, 0, STEEPEST)


def test_followed_edges_are_those_of_the_definition(views: list[PaneView], planes: FramedPlanes) -> None:
    matches = edge_matches(planes, views, edges_per_view=40)
    seen = []
    for number, view in enumerate(views):
        chosen = np.flatnonzero(matches.sources == number)
        thinned = slice(None, None, max(len(view.edge) // 40, 1))
        points, hit = intersect_rays(planes, view.center, view.directions(view.edge[thinned]))
        limits = view.line_plane_normals(view.edge[thinned], view.outward[thinned])
        outward = limits - (planes.normals @ limits.T)[..., None] * planes.normals[:, None]
        outward /= np.maximum(np.linalg.norm(outward, axis=2, keepdims=True), 1e-9)
        own_size, own_hidden = pixel_and_frame(planes, view, points, outward)
        assert points.shape[1] == len(chosen)
        for other, target in enumerate(views):
            landed, held = target.project(points)
            compared = held & hit & (target is not view)
            assert (matches.compared[:, other, chosen] == compared).all()
            size, hidden = pixel_and_frame(planes, target, points, outward)
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                doubt = target.diagonal * np.sqrt((1 + (own_size / size) ** 2) / 2)
                shifts, most = (own_hidden - hidden) / (size * doubt), STEEPEST / (size * doubt)
            distances = target.edge_distances(np.where(compared[..., None], landed, 0).reshape(-1, 2))
            distances = distances.reshape(compared.shape) / doubt
            for name, expected in (("distances", distances), ("shifts", shifts)):
                found = getattr(matches, name)[:, other, chosen]
                assert (found[~compared] == 0).all()
                # For a plane that contains the camera, the viewing angle depends on rounding, between two bounds.
                aside = np.abs(planes.normals @ view.center - planes.offsets)[:, None] > 1e-9
                sure = compared if name == "distances" else compared & aside
                np.testing.assert_allclose(found[sure], expected[sure], rtol=1e-9, atol=1e-12)
                assert name == "distances" or (np.abs(found[compared]) <= most[compared] * (1 + 1e-9)).all()
            seen.append(compared.sum())
    assert sum(np.array(seen) > 100) > 40


def test_edges_are_unknown_where_distances_are_unknown(views: list[PaneView]) -> None:
    plane = FRONT.plane
    known = edge_matches(plane, views, edges_per_view=60)
    blind = replace(views[1], distance=np.full(views[1].distance.shape, np.nan))
    found = edge_matches(plane, [views[0], blind, *views[2:]], edges_per_view=60)
    assert np.isnan(found.distances[0, 1][known.compared[0, 1]]).all() and known.compared[0, 1].sum() > 100
    others = np.arange(len(views)) != 1
    assert (found.distances[:, others] == known.distances[:, others]).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (6, 1), (5, 4)])
def test_images_of_any_size_are_interpolated_up_to_their_rims(shape: tuple[int, int]) -> None:
    height, width = shape
    rng = np.random.default_rng(1)
    field, places = rng.standard_normal(shape), rng.random((200, 2)) * (width, height)
    # Both look along z: the first from two units in front of the plane, the second from one.
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, 2, 3] = 1.0
    lenses, sizes = np.tile([1.0, 1.0, 0.0, 0.0], (2, 1)), np.array([[9, 9], shape])
    cameras = Cameras(poses, np.array([[0, 0, -1.0], [0, 0, 0]]), lenses, sizes)
    rays = np.column_stack([places / 2, np.ones(200)])
    edges = Edges(np.zeros(200, np.int64), rays, np.tile([1.0, 0, 0], (200, 1)))
    found = follow_edges(np.array([[0, 0, 1.0]]), np.ones(1), cameras, edges, [np.zeros((9, 9)), field])
    assert found.compared[0, 1].all() and not found.compared[0, 0].any()
    own, other = 2 * np.sqrt(1 + (places[:, 0] / 2) ** 2), np.sqrt(1 + places[:, 0] ** 2)
    doubt = np.hypot(*shape) * np.sqrt((1 + (own / other) ** 2) / 2)
    expected = replace(pane_view(*scene_of([FRONT])[0], 1), distance=field).edge_distances(places) / doubt
    np.testing.assert_allclose(found.distances[0, 1], expected, rtol=1e-9, atol=1e-12)


def test_overlaps_are_those_of_the_definition(views: list[PaneView], planes: FramedPlanes) -> None:
    both, either = np.zeros((2, len(views), len(views), len(planes)))
    for number, source in enumerate(views):
        pixels = source.pixel_grid(90)
        everywhere = np.ones(len(pixels), dtype=bool)
        pixels = pixels[source.is_unoccluded(pixels, everywhere)]
        on_pane = source.covers(pixels, everywhere[: len(pixels)])
        points, hit = intersect_rays(planes, source.center, source.directions(pixels))
        for other, target in enumerate(views):
            if target is not source:
                landed, held = target.project(points)
                held = target.is_unoccluded(landed, held & hit)
                covered = target.covers(landed, held)
                both[number, other] = (covered & on_pane).sum(axis=1)
                unknown, missed = (hit & on_pane & ~held).sum(axis=1), (on_pane & ~hit).sum(axis=1)
                either[number, other] = (held & (covered | on_pane)).sum(axis=1) + missed + UNKNOWN_WEIGHT * unknown
    expected = both.sum(axis=(0, 1)) / np.maximum(either.sum(axis=(0, 1)), 1)
    np.testing.assert_allclose(mask_agreement(planes, views, pixels_per_view=90), expected, rtol=1e-12)
    assert expected[0] > 0.9 and expected.min() < 0.05
    alone = mask_agreement(planes.select(np.arange(1)), views)
    assert 0.9 < agreement_per_view(planes.select(np.arange(1)), views).mean() < 1.1 * alone[0]


def test_a_field_is_summed_over_mirror_images() -> None:
    rng = np.random.default_rng(2)
    values, corner, cell = rng.random((5, 6, 7)).astype(np.float32), np.array([-1.0, -1.2, 0.3]), 0.4
    points, normals = rng.standard_normal((50, 3)), rng.standard_normal((40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = rng.standard_normal(40)
    images = points - 2 * ((points @ normals.T - offsets).T)[..., None] * normals[:, None]
    index = np.floor((images - corner) / cell).astype(int)
    inside = ((index >= 0) & (index < values.shape)).all(axis=-1)
    expected = np.where(inside, values[tuple(np.where(inside[..., None], index, 0).transpose(2, 0, 1))], 0).sum(axis=1)
    assert 0.05 < inside.mean() < 0.9
    np.testing.assert_allclose(sum_mirrored(normals, offsets, points, Field(values, corner, cell)), expected, rtol=1e-6)


def test_threads_change_no_bit(views: list[PaneView], planes: FramedPlanes) -> None:
    def compute() -> list[torch.Tensor]:
        matches = edge_matches(planes, views, edges_per_view=40)
        return [torch.from_numpy(found) for found in (matches.distances, matches.shifts, matches.misalignments)]

    assert_threads_change_no_bit(compute)
