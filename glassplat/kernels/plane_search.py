"""Inner loops of the search for a pane's plane: mask edges transferred to other views, and points mirrored in planes.

A search tests thousands of planes on a few hundred rays or points. Each pair of plane and ray takes a few products and
one image lookup, so all is computed in one pass without intermediate arrays. Everything runs in double precision on the
CPU.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from glassplat.kernels.backend.cpu import Kernel, array_at, inlined, kernel

Array = NDArray[np.float64]
Image = NDArray[np.bool_]

PARALLEL = 1e-9
"""Dot product of a ray and a plane's normal below which the ray is treated as parallel to the plane."""
SMALLEST = 1e-100
"""Lower bound of heights and pixel sizes; its square does not underflow."""
STEEPEST = 8.0
"""Upper bound of a camera's offset beyond an edge, in multiples of its height over the plane. Cameras farther out see
the pane at grazing angles."""


class Cameras(NamedTuple):
    """Cameras of V views: poses [V, 4, 4] (world to camera), centers [V, 3], lenses [V, 4] (fx, fy, cx, cy in pixels),
    sizes [V, 2] (height, width).
    """

    poses: Array
    centers: Array
    lenses: Array
    sizes: NDArray[np.int64]


class Edges(NamedTuple):
    """P points of mask edges, as seen by their cameras.

    sources [P]: the view of each; rays [P, 3]: directions to them, with a camera z of 1; limits [P, 3]: unit normals of
    the planes through camera and edge, pointing away from the pane.
    """

    sources: NDArray[np.int64]
    rays: Array
    limits: Array


class Rays(NamedTuple):
    """P rays through pixels: sources [P], the view of each; rays [P, 3] as in `Edges`; on_pane [P]: true where the mask
    marks the pane.
    """

    sources: NDArray[np.int64]
    rays: Array
    on_pane: NDArray[np.bool_]


class FollowedEdges(NamedTuple):
    """Edges on H planes, and their positions in V views: distances, shifts [H, V, P], outward [H, P, 3], compared
    [H, V, P]; `EdgeMatches` describes them.
    """

    distances: Array
    shifts: Array
    outward: Array
    compared: NDArray[np.bool_]


class Field(NamedTuple):
    """Values [X, Y, Z] (float32) of the cells of a box, the position of its corner [3], and the size of a cell, in
    world units; 0 outside of the box.
    """

    values: NDArray[np.float32]
    corner: Array
    cell: float


def follow_edges(normals: Array, offsets: Array, cameras: Cameras, edges: Edges, fields: list[Array]) -> FollowedEdges:
    """Transfers mask edges to all views over each plane.

    Args:
        normals: [H, 3] unit normals of the planes.
        offsets: [H] of the planes: normal . x = offset.
        cameras: of V views.
        edges: P points.
        fields: one image for each view: signed distances from pixel centres to the mask's edge, positive on the pane.
    """
    planes, views, points = len(offsets), len(fields), len(edges.sources)
    distances, shifts = np.empty((2, planes, views, points))
    outward, compared = np.empty((planes, points, 3)), np.empty((planes, views, points), np.bool_)
    fields = [np.ascontiguousarray(field, np.float64) for field in fields]  # Kept alive until the kernel has returned.
    addresses = np.array([field.ctypes.data for field in fields], np.int64)
    follow_edges_kernel()(normals, offsets, *cameras, *edges, addresses, distances, shifts, outward, compared)
    return FollowedEdges(distances, shifts, outward, compared)


def overlaps(
    normals: Array, offsets: Array, cameras: Cameras, rays: Rays, masks: list[Image], hidden: list[Image],
    unknown_weight: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Counts of rays on the pane in both of two views, and in at least one; [H, V, V] each, from and to.

    Args:
        normals: [H, 3] unit normals of the planes.
        offsets: [H] of the planes: normal . x = offset.
        cameras: of V views.
        rays: P rays.
        masks: one image for each view, true on the pane.
        hidden: one image for each view, true where the mask is unknown.
        unknown_weight: weight of a ray on the pane that is outside the other view or hidden in it.
    """
    both, either = np.zeros((2, len(offsets), len(masks), len(masks)))
    images = [np.ascontiguousarray(image, np.bool_) for image in (*masks, *hidden)]
    addresses = np.array([image.ctypes.data for image in images], np.int64).reshape(2, -1)
    overlaps_kernel()(normals, offsets, *cameras, *rays, addresses, unknown_weight, both, either)
    return both, either


def sum_mirrored(normals: Array, offsets: Array, points: Array, field: Field) -> Array:
    """Sums [H] of the field over the mirror images of points [N, 3] in each of H planes normal . x = offset."""
    sums = np.empty(len(offsets))
    sum_mirrored_kernel()(normals, offsets, points, *field, sums)
    return sums


@inlined
def along_ray(normal, offset, center, ray):
    """Distance along a ray to a plane; not positive behind its origin."""
    slope = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    if abs(slope) < PARALLEL:
        slope = PARALLEL
    return (offset - normal[0] * center[0] - normal[1] * center[1] - normal[2] * center[2]) / slope


@inlined
def project_to_image(pose, lens, size, x, y, z):
    """Column and row of a point in an image, in pixels, its depth, and whether it is inside the image."""
    depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    if not depth > 0.0:
        return 0.0, 0.0, depth, False
    scale = 1.0 / depth
    column = lens[0] * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) * scale + lens[2]
    row = lens[1] * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) * scale + lens[3]
    return column, row, depth, column >= 0.0 and column < size[1] and row >= 0.0 and row < size[0]


@inlined
def interpolated(field, size, column, row):
    """Bilinearly interpolated value of an image at a position inside it."""
    x, y = min(max(column - 0.5, 0.0), size[1] - 1.0), min(max(row - 0.5, 0.0), size[0] - 1.0)
    left, top = min(int(x), max(size[1] - 2, 0)), min(int(y), max(size[0] - 2, 0))
    right, low = min(left + 1, size[1] - 1), min(top + 1, size[0] - 1)
    x, y = x - left, y - top
    upper = (1.0 - x) * field[top * size[1] + left] + x * field[top * size[1] + right]
    lower = (1.0 - x) * field[low * size[1] + left] + x * field[low * size[1] + right]
    return (1.0 - y) * upper + y * lower


@functools.cache
def follow_edges_kernel() -> Kernel:
    """Fills the results of `follow_edges`, plane by plane."""
    at = array_at(np.float64)

    @kernel("follow_edges", np.float64)
    def follow(
        normals, offsets, poses, centers, lenses, sizes, sources, rays, limits, addresses, distances, shifts, outward,
        compared,
    ):  # fmt: skip
        views = sizes.shape[0]
        pixels, diagonals = np.empty(views), np.empty(views)
        for v in range(views):
            pixels[v] = 1.0 / math.sqrt(lenses[v, 0] * lenses[v, 1])
            diagonals[v] = 1.0 / math.sqrt(float(sizes[v, 0] * sizes[v, 0] + sizes[v, 1] * sizes[v, 1]))
        for h in prange(offsets.size):
            normal, offset = normals[h], offsets[h]
            # Inverse heights: a camera's offset beyond an edge, times this, is the tangent of its viewing angle.
            heights = np.empty(views)
            for v in range(views):
                n, c = normal, centers[v]
                heights[v] = 1.0 / max(abs(n[0] * c[0] + n[1] * c[1] + n[2] * c[2] - offset), SMALLEST)
            for p in range(sources.size):
                source, ray, limit = sources[p], rays[p], limits[p]
                own = centers[source]
                along = along_ray(normal, offset, own, ray)
                hit = along > 0.0
                along = along if hit else 0.0
                x, y, z = own[0] + along * ray[0], own[1] + along * ray[1], own[2] + along * ray[2]

                across = normal[0] * limit[0] + normal[1] * limit[1] + normal[2] * limit[2]
                out_x, out_y = limit[0] - across * normal[0], limit[1] - across * normal[1]
                out_z = limit[2] - across * normal[2]
                length = 1.0 / max(math.sqrt(out_x * out_x + out_y * out_y + out_z * out_z), PARALLEL)
                out_x, out_y, out_z = length * out_x, length * out_y, length * out_z
                outward[h, p, 0], outward[h, p, 1], outward[h, p, 2] = out_x, out_y, out_z

                passing = out_x * x + out_y * y + out_z * z
                steep = (out_x * own[0] + out_y * own[1] + out_z * own[2] - passing) * heights[source]
                # `along` is the depth in the source camera, because rays have a camera z of 1.
                own_pixel = max(along * math.sqrt(1.0 + steep * steep) * pixels[source], SMALLEST)
                own_hidden = min(max(steep, 0.0), STEEPEST)
                for v in range(views):
                    c, size = centers[v], sizes[v]
                    column, row, depth, held = project_to_image(poses[v], lenses[v], size, x, y, z)
                    held = held and hit and source != v
                    compared[h, v, p] = held
                    if not held:
                        distances[h, v, p] = shifts[h, v, p] = 0.0
                        continue
                    steep = (out_x * c[0] + out_y * c[1] + out_z * c[2] - passing) * heights[v]
                    pixel = max(depth * math.sqrt(1.0 + steep * steep) * pixels[v], SMALLEST)
                    hidden = min(max(steep, 0.0), STEEPEST)
                    # Inverse of a one-pixel uncertainty in both views, on the plane; this view's pixel is `pixel`
                    # large.
                    doubt = diagonals[v] / math.sqrt(0.5 * (pixel * pixel + own_pixel * own_pixel))
                    field = at(addresses[v], 0, size[0] * size[1])
                    distances[h, v, p] = interpolated(field, size, column, row) * pixel * doubt
                    shifts[h, v, p] = (own_hidden - hidden) * doubt

    return follow


@functools.cache
def overlaps_kernel() -> Kernel:
    """Accumulates the results of `overlaps`, plane by plane."""
    at = array_at(np.bool_)

    @kernel("mask_overlaps", np.float64, parallel=False)
    def add(
        normals, offsets, poses, centers, lenses, sizes, sources, rays, on_pane, addresses, unknown_weight, both, either
    ):  # fmt: skip
        for h in range(offsets.size):
            for p in range(sources.size):
                source, ray, on = sources[p], rays[p], on_pane[p]
                own = centers[source]
                along = along_ray(normals[h], offsets[h], own, ray)
                hit = along > 0.0
                x, y, z = own[0] + along * ray[0], own[1] + along * ray[1], own[2] + along * ray[2]
                for v in range(sizes.shape[0]):
                    if v == source:
                        continue
                    size = sizes[v]
                    if not hit:
                        # A plane behind the camera cannot hold a pane that the camera sees.
                        either[h, source, v] += 1.0 if on else 0.0
                        continue
                    column, row, _, held = project_to_image(poses[v], lenses[v], size, x, y, z)
                    pixel = int(row) * size[1] + int(column) if held else 0
                    if not held or at(addresses[1, v], 0, size[0] * size[1])[pixel]:
                        either[h, source, v] += unknown_weight if on else 0.0
                        continue
                    covered = at(addresses[0, v], 0, size[0] * size[1])[pixel]
                    both[h, source, v] += 1.0 if covered and on else 0.0
                    either[h, source, v] += 1.0 if covered or on else 0.0

    return add


@functools.cache
def sum_mirrored_kernel() -> Kernel:
    """Fills the results of `sum_mirrored`, plane by plane."""

    @kernel("sum_mirrored", np.float64, parallel=False)
    def add(normals, offsets, points, values, corner, cell, sums):
        columns, rows, layers = values.shape
        scale = 1.0 / cell
        for h in range(offsets.size):
            n, found = normals[h], 0.0
            for i in range(points.shape[0]):
                p = points[i]
                twice = 2.0 * (n[0] * p[0] + n[1] * p[1] + n[2] * p[2] - offsets[h])
                x = math.floor((p[0] - twice * n[0] - corner[0]) * scale)
                y = math.floor((p[1] - twice * n[1] - corner[1]) * scale)
                z = math.floor((p[2] - twice * n[2] - corner[2]) * scale)
                if 0.0 <= x < columns and 0.0 <= y < rows and 0.0 <= z < layers:
                    found += values[int(x), int(y), int(z)]
            sums[h] = found

    return add
