"""Fit of a pane's plane to marks of its outline in several photographs, with its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from glassplat.scene.camera import NumpyCamera

Array = NDArray[np.float64]

RECTANGLE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Corners in units of half sides, in order around the rectangle."""


@dataclass(frozen=True)
class RectanglePane:
    """A rectangle: orientation, centre and two half sides."""

    axes: Array
    """[3, 3] rows: directions of the first and the second side, and the normal."""
    center: Array
    half_sizes: Array

    @property
    def num_parameters(self) -> int:
        """Three for rotation, three for translation, two for the sides."""
        return 8

    def corners(self) -> Array:
        """[4, 3]."""
        return np.asarray(self.center + (RECTANGLE * self.half_sizes) @ self.axes[:2])

    def apply_step(self, step: Array) -> RectanglePane:
        """The shape after a step: translation in units of the longer half side, logarithmic factors of the sides."""
        return RectanglePane(
            axes=_rotate_axes(self.axes, step[:3]),
            center=self.center + self.half_sizes.max() * step[3:6] @ self.axes,
            half_sizes=self.half_sizes * np.exp(np.clip(step[6:8], -1, 1)),
        )


@dataclass(frozen=True)
class PolygonPane:
    """A planar polygon."""

    axes: Array
    """[3, 3] rows: two directions in the plane, and its normal."""
    center: Array
    plane_corners: Array
    """[K, 2] corners along the first two axes, from the centre."""

    @property
    def num_parameters(self) -> int:
        """Two for the tilt, one for translation along the normal, two for each corner."""
        return 3 + 2 * len(self.plane_corners)

    def corners(self) -> Array:
        """[K, 3]."""
        return np.asarray(self.center + self.plane_corners @ self.axes[:2])

    def apply_step(self, step: Array) -> PolygonPane:
        """The shape after a step; lengths are in units of the largest distance of a corner from the centre."""
        reach = float(np.linalg.norm(self.plane_corners, axis=1).max())
        return replace(
            self,
            axes=_rotate_axes(self.axes, np.append(step[:2], 0.0)),
            center=self.center + reach * step[2] * self.axes[2],
            plane_corners=self.plane_corners + reach * step[3:].reshape(-1, 2),
        )


PaneShape = RectanglePane | PolygonPane
"""A planar shape; the first two parameters of a step tilt its plane, in radians."""


def polygon_pane(corners: Array) -> PolygonPane:
    """The polygon of points [K, 3], projected onto their least-squares plane."""
    center = corners.mean(axis=0)
    _, sizes, axes = np.linalg.svd(corners - center)
    if sizes[1] <= 1e-6 * sizes[0]:
        raise ValueError("the corners are collinear; expected an outline that encloses an area")
    axes = axes * np.array([[1.0], [1.0], [np.linalg.det(axes)]])
    return PolygonPane(axes, center, (corners - center) @ axes[:2].T)


def rectangle_pane(polygon: PolygonPane) -> RectanglePane:
    """A rectangle fitted to a polygon of four corners, which may be far from rectangular."""
    a, b, c, d = polygon.plane_corners
    along, across = (b - a + c - d) / 2, (d - a + c - b) / 2
    # The direction that best fits both pairs of sides, with the second pair rotated back by 90 degrees.
    turn = 1.0 if along[0] * across[1] - along[1] * across[0] > 0 else -1.0
    direction = along + turn * np.array([across[1], -across[0]])
    first = direction / np.linalg.norm(direction)
    second = turn * np.array([-first[1], first[0]])
    axes = np.stack([first @ polygon.axes[:2], second @ polygon.axes[:2], turn * polygon.axes[2]])
    half_sizes = np.maximum([along @ first / 2, across @ second / 2], 1e-3 * np.abs(polygon.plane_corners).max())
    return RectanglePane(axes, polygon.center + polygon.plane_corners.mean(axis=0) @ polygon.axes[:2], half_sizes)


def _rotate_axes(axes: Array, angles: Array) -> Array:
    """Axes rotated about themselves by a rotation vector, in radians."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(angles).as_matrix().T @ axes)


Shape = Literal["rectangle", "polygon"]

ACCURACY = 1.0 / 1000
"""Best accuracy of a mark, in image diagonals."""
OUTLIER = 4.0
"""Residual, in accuracies, above which marks are down-weighted."""
LEAST_PARALLAX = np.radians(0.5)
"""Minimum angle between two sight lines for triangulation; below it, depth is unreliable."""
DERIVATIVE_STEP = 1e-5


class TooFewMarksError(ValueError):
    """Raised when the marks do not determine the plane; the message names the missing ones."""


@dataclass(frozen=True)
class Marks:
    """Marks of one pane; views are identified by index.

    Attributes:
        corners: for each corner, in order around the outline, its pixel (x, y) in every view with a mark.
        edges: for each edge, which starts at the corner of the same index, two pixels on it in every view with a mark.
    """

    corners: Sequence[Mapping[int, Array]]
    edges: Sequence[Mapping[int, Array]] = field(default_factory=tuple)

    def views(self) -> list[int]:
        """Views with any mark, ascending."""
        return sorted({view for marks in (*self.corners, *self.edges) for view in marks})


@dataclass(frozen=True)
class PaneFit:
    """A pane fitted to marks.

    Attributes:
        shape: the outline in the world.
        error: root mean square distance of marks from it, in pixels.
        errors: the largest distance of a mark in each view, in pixels.
        information: [F, F] inverse covariance of the shape's parameters, those of `apply_step`.
    """

    shape: PaneShape
    error: float
    errors: Mapping[int, float]
    information: Array

    @property
    def uncertainty(self) -> float:
        """Standard deviation of the plane's tilt along its least certain axis, degrees."""
        return tilt_deviation(self.information)


def tilt_deviation(information: Array) -> float:
    """Standard deviation of the least certain tilt, degrees; 90 if the marks do not constrain it."""
    tilt, mixed, rest = information[:2, :2], information[:2, 2:], information[2:, 2:]
    # The tilt's information with all other parameters marginalised out; the extent of edges may be undetermined.
    alone = tilt - mixed @ np.linalg.pinv(rest, rcond=1e-10, hermitian=True) @ mixed.T
    least = float(np.linalg.eigvalsh(alone)[0])
    return 90.0 if least <= np.degrees(1) ** -2 * 1e-4 else min(float(np.degrees(1 / np.sqrt(least))), 90.0)


def fit_pane(marks: Marks, cameras: Sequence[NumpyCamera], shape: Shape) -> PaneFit:
    """The outline that best fits all marks, by a robust loss that gives outliers little weight.

    Args:
        marks: corners and edges by index of the view.
        cameras: the cameras of all views.
        shape: a rectangle (of four corners), or any polygon.

    Raises:
        TooFewMarksError: too few corners are known from two positions; the message names the missing marks.
    """
    fits = [_fit_from(marks, cameras, start) for start in _initial_outlines(marks, cameras, shape)]
    _, fitted = min(fits, key=lambda fit: fit[0])
    residuals = mark_residuals(marks, cameras, fitted)
    jacobian = _jacobian(marks, cameras, fitted)
    spread = max(1.0, float(np.sqrt((residuals**2).sum() / max(len(residuals) - fitted.num_parameters, 1))))
    pixels = [(view, float(np.linalg.norm(offset))) for view, offset in _mark_offsets(marks, cameras, fitted)]
    largest = {view: max(one for number, one in pixels if number == view) for view in marks.views()}
    error = float(np.sqrt(np.mean([one**2 for _, one in pixels])))
    return PaneFit(fitted, error, largest, jacobian.T @ jacobian / spread**2)


def _fit_from(marks: Marks, cameras: Sequence[NumpyCamera], start: PaneShape) -> tuple[float, PaneShape]:
    """The robust cost and the shape of a fit that starts at the given shape."""
    from scipy.optimize import least_squares

    def residuals(step: Array) -> Array:
        return mark_residuals(marks, cameras, start.apply_step(step))

    step, cost = np.zeros(start.num_parameters), np.inf
    for loss in ("soft_l1", "cauchy"):  # Cauchy first would stay at a poor start, where all marks are outliers.
        found = least_squares(residuals, step, loss=loss, f_scale=OUTLIER, x_scale="jac", max_nfev=100)
        step, cost = found.x, float(found.cost)
    return cost, start.apply_step(step)


def mark_residuals(marks: Marks, cameras: Sequence[NumpyCamera], shape: PaneShape) -> Array:
    """[R] residuals of all marks, in accuracies: two for a corner, one for each pixel on an edge."""
    parts = [offset / (ACCURACY * cameras[view].diagonal) for view, offset in _mark_offsets(marks, cameras, shape)]
    return np.concatenate(parts)


def corner_information(camera: NumpyCamera, shape: PaneShape) -> Array:
    """[F, F] information that a fit would gain if all corners visible in a view were marked."""
    pixels, inside = camera.project(shape.corners()), camera.contains(shape.corners())
    marks = Marks([{0: pixel} if seen else {} for pixel, seen in zip(pixels, inside, strict=True)])
    if not inside.any():
        return np.zeros((shape.num_parameters, shape.num_parameters))
    jacobian = _jacobian(marks, [camera], shape)
    return jacobian.T @ jacobian


def _jacobian(marks: Marks, cameras: Sequence[NumpyCamera], shape: PaneShape) -> Array:
    """[R, F] by central differences."""
    columns = []
    for axis in np.eye(shape.num_parameters):
        ahead, behind = (
            mark_residuals(marks, cameras, shape.apply_step(sign * DERIVATIVE_STEP * axis)) for sign in (1.0, -1.0)
        )
        columns.append((ahead - behind) / (2 * DERIVATIVE_STEP))
    return np.stack(columns, axis=1)


def _mark_offsets(marks: Marks, cameras: Sequence[NumpyCamera], shape: PaneShape) -> list[tuple[int, Array]]:
    """The view and the residual of each mark, in pixels: [2] of a corner, [2] perpendicular to an edge."""
    corners = shape.corners()
    found = []
    for number, pixels in enumerate(marks.corners):
        found += [(view, cameras[view].project(corners[number]) - pixel) for view, pixel in pixels.items()]
    for number, pixels in enumerate(marks.edges):
        ends = corners[[number, (number + 1) % len(corners)]]
        found += [(view, _distances_from_line(cameras[view].project(ends), pixel)) for view, pixel in pixels.items()]
    return found


def _distances_from_line(line: Array, pixels: Array) -> Array:
    """[2] distances of two pixels from the line through two others."""
    along = line[1] - line[0]
    length = max(float(np.hypot(*along)), 1e-9)
    offset = pixels - line[0]
    return np.asarray((along[0] * offset[:, 1] - along[1] * offset[:, 0]) / length)


def _initial_outlines(marks: Marks, cameras: Sequence[NumpyCamera], shape: Shape) -> list[PaneShape]:
    """Initial outlines, at least one.

    An edge or a corner marked in one view only does not constrain the plane, only the extent of the pane. Therefore,
    additional starts are the fit to all other marks, clipped by such edges, or stretched to such corners.

    Raises:
        TooFewMarksError: the marks do not determine the plane.
    """
    starts = [polygon_pane(_initial_corners(marks, cameras))]
    repeated, single = _split_single_marks(marks.edges)
    if single:
        pane = fit_pane(replace(marks, edges=repeated), cameras, shape).shape
        starts.append(polygon_pane(_move_edges(marks, cameras, pane, single)))
    repeated, single = _split_single_marks(marks.corners)
    if single:
        with suppress(ValueError):  # Without these corners, or with a wrong one, the fit may be degenerate.
            pane = fit_pane(replace(marks, corners=repeated), cameras, shape).shape
            starts.append(polygon_pane(_stretch_to_corners(marks, cameras, pane, single)))
    return [rectangle_pane(start) if shape == "rectangle" and len(marks.corners) == 4 else start for start in starts]


def _split_single_marks(marks: Sequence[Mapping[int, Array]]) -> tuple[list[Mapping[int, Array]], list[int]]:
    """Marks of corners or edges, without those marked in one view only, and the indices of the latter."""
    single = [number for number, pixels in enumerate(marks) if len(pixels) == 1]
    return [{} if number in single else pixels for number, pixels in enumerate(marks)], single


def _stretch_to_corners(marks: Marks, cameras: Sequence[NumpyCamera], pane: PaneShape, single: Sequence[int]) -> Array:
    """[K, 3] the corners of a pane, some of them moved to their marks in a single view.

    Of four corners, the opposite one is fixed, and the adjacent ones keep the directions of their sides.
    """
    corners = pane.corners()
    for number in single:
        point = _corner_on_plane(marks, number, cameras, corners.mean(axis=0), pane.axes[2])
        if point is None:
            continue
        if len(corners) == 4:
            before, after, across = number - 1, (number + 1) % 4, corners[number - 2]
            sides = np.stack([corners[before] - across, corners[after] - across], axis=1)
            shares = np.linalg.lstsq(sides, point - across, rcond=None)[0]
            corners[before], corners[after] = across + shares[0] * sides[:, 0], across + shares[1] * sides[:, 1]
        corners[number] = point
    return corners


def _move_edges(marks: Marks, cameras: Sequence[NumpyCamera], pane: PaneShape, single: Sequence[int]) -> Array:
    """[K, 3] the corners of a pane, some edges of which are moved to their marks in a single view."""
    corners = pane.corners()
    for number in single:
        line = _edge_on_plane(marks.edges[number], cameras, pane)
        around = [corners[(number + step) % len(corners)] for step in (-1, 0, 1, 2)]
        first, second = (_intersect_lines(line, (around[before], around[before + 1])) for before in (0, 2))
        if first is not None and second is not None:
            corners[number], corners[(number + 1) % len(corners)] = first, second
    return corners


def _edge_on_plane(
    pixels: Mapping[int, Array], cameras: Sequence[NumpyCamera], pane: PaneShape
) -> tuple[Array, Array] | None:
    """Intersections of an edge's two sight lines, seen in one view, with a pane's plane; None if they diverge."""
    ((view, ends),) = pixels.items()
    rays, normal, center = cameras[view].rays(np.asarray(ends)), pane.axes[2], cameras[view].center
    heights, cosines = (pane.corners().mean(axis=0) - center) @ normal, rays @ normal
    if (cosines * heights <= 1e-3 * abs(heights)).any():
        return None
    first, second = center + rays * (heights / cosines)[:, None]
    return first, second


def _initial_corners(marks: Marks, cameras: Sequence[NumpyCamera]) -> Array:
    """[K, 3] all corners: triangulated, intersected from two edges or with the plane of the others, or completed.

    Raises:
        TooFewMarksError: fewer than three are known from two positions.
    """
    lines = [_edge_line(pixels, cameras) for pixels in marks.edges] + [None] * (len(marks.corners) - len(marks.edges))
    known = [
        _triangulate(pixels, cameras) if len(pixels) > 1 else _intersect_lines(lines[number - 1], lines[number])
        for number, pixels in enumerate(marks.corners)
    ]
    points = [point for point in known if point is not None]
    spanning = points + [point for line in lines if line is not None for point in line]
    if len(spanning) < 3:
        raise TooFewMarksError(_missing_marks_message(marks, len(points)))
    plane = polygon_pane(np.stack(spanning))
    completed = [
        point if point is not None else _corner_on_plane(marks, number, cameras, plane.center, plane.axes[2])
        for number, point in enumerate(known)
    ]
    return np.stack(_complete_corners(completed, lines))


def _missing_marks_message(marks: Marks, known: int) -> str:
    views = marks.views()
    if len(views) < 2:
        return "mark the same corners in a second photograph, taken from another position"
    corners = "1 corner is" if known == 1 else f"{known} corners are"
    return (
        f"{corners} known from two positions, expected at least 3: mark the same corners in two photographs "
        "taken farther apart"
    )


def _triangulate(pixels: Mapping[int, Array], cameras: Sequence[NumpyCamera]) -> Array | None:
    """[3] the point nearest to all sight lines; None if they are too close to parallel."""
    centers = np.stack([cameras[view].center for view in pixels])
    rays = np.stack([cameras[view].rays(np.asarray(pixel)) for view, pixel in pixels.items()])
    if np.arccos(np.clip((rays @ rays.T).min(), -1, 1)) < LEAST_PARALLAX:
        return None
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.linalg.solve(across.sum(axis=0), np.einsum("vij,vj->i", across, centers))


def _edge_line(pixels: Mapping[int, Array], cameras: Sequence[NumpyCamera]) -> tuple[Array, Array] | None:
    """Two points on the intersection of an edge's planes of sight, at the marks of the first view, or None."""
    if len(pixels) < 2:
        return None
    rays = {view: cameras[view].rays(np.asarray(pixel)) for view, pixel in pixels.items()}
    normals = np.stack([np.cross(*ends) for ends in rays.values()])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    _, sizes, axes = np.linalg.svd(normals)
    if sizes[1] < LEAST_PARALLAX * sizes[0]:
        return None
    offsets = np.array([normal @ cameras[view].center for normal, view in zip(normals, pixels, strict=True)])
    point, direction = np.linalg.lstsq(normals, offsets, rcond=1e-9)[0], axes[2]
    view = next(iter(pixels))
    first, second = (_nearest_on_line(point, direction, cameras[view].center, ray) for ray in rays[view])
    return first, second


def _nearest_on_line(point: Array, direction: Array, center: Array, ray: Array) -> Array:
    """[3] the point of a line that is closest to a sight line."""
    across = np.eye(3) - np.outer(ray, ray)
    along = float(direction @ across @ direction)
    return np.asarray(point + direction * (direction @ across @ (center - point)) / max(along, 1e-12))


def _intersect_lines(before: tuple[Array, Array] | None, after: tuple[Array, Array] | None) -> Array | None:
    """[3] the midpoint between the closest points of two lines; None if one is missing or they are parallel."""
    if before is None or after is None:
        return None
    one, other = (line[1] - line[0] for line in (before, after))
    matrix = np.stack([one, -other], axis=1)
    steps, _, _, sizes = np.linalg.lstsq(matrix, after[0] - before[0], rcond=None)
    if sizes[1] < 0.05 * sizes[0]:
        return None
    first, second = before[0] + steps[0] * one, after[0] + steps[1] * other
    return np.asarray((first + second) / 2)


def _corner_on_plane(
    marks: Marks, number: int, cameras: Sequence[NumpyCamera], center: Array, normal: Array
) -> Array | None:
    """[3] intersection of a corner's first usable sight line with the plane of the others; None if there is none."""
    for view, pixel in marks.corners[number].items():
        ray = cameras[view].rays(np.asarray(pixel))
        cosine = ray @ normal
        if abs(cosine) > 1e-3:
            return np.asarray(cameras[view].center + ray * ((center - cameras[view].center) @ normal) / cosine)
    return None


def _complete_corners(corners: list[Array | None], lines: Sequence) -> list[Array]:
    """All corners; unknown ones become ends of a marked edge, or the fourth corner of a parallelogram.

    Raises:
        TooFewMarksError: some corners remain unknown.
    """
    count = len(corners)
    for number in range(count):
        if corners[number] is None:
            before, after = lines[number - 1], lines[number]
            found = after[0] if after is not None else before[1] if before is not None else None
            corners[number] = found
    for number in range(count):
        if corners[number] is None and count == 4:
            a, b, c = (corners[(number + step) % 4] for step in (1, 2, 3))
            if a is not None and b is not None and c is not None:
                corners[number] = a + c - b
    missing = [str(number + 1) for number, corner in enumerate(corners) if corner is None]
    if missing:
        raise TooFewMarksError(f"mark corner {', '.join(missing)} too, in at least one photograph")
    return [corner for corner in corners if corner is not None]
