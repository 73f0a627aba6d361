"""Annotated masks of a pane, their edges and rays; planes and rectangles through points; and agreement of masks.

A plane induces a homography, which maps every pixel of one view to a pixel of another. On the pane's own plane, the
mask of the first view lands on the mask of the second; on any other plane, parallax separates them. Nothing is known
outside an image, so a mask that leaves its image is not a contradiction. Nor is anything known where a mask shows
another pane, which may be in front.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.plane_search import Cameras, Rays, overlaps
from glassplat.scene.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rectangle:
    """A rectangle in the plane, longer side first.

    Attributes:
        center: [2] its middle.
        axis: [2] unit direction of its longer side; the other side is at +90 degrees.
        half_sizes: [2] half the length of the longer and of the shorter side.
    """

    center: Array
    axis: Array
    half_sizes: Array


def min_area_rectangle(points: Array) -> Rectangle:
    """The rectangle of minimum area that contains all points [P, 2].

    One of its sides lies along an edge of the convex hull (Freeman and Shapira, 1975), so it is
    enough to measure the hull along each of its edges.

    Raises:
        ValueError: the points do not span an area.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = points[ConvexHull(points).vertices]
    except (QhullError, ValueError) as error:
        raise ValueError(f"{len(points)} points do not span an area; expected at least three off one line") from error
    edges = np.roll(hull, -1, axis=0) - hull
    along = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    extents = np.stack([hull @ along.T, hull @ across.T])  # [2, P, E]
    low, high = extents.min(axis=1), extents.max(axis=1)
    best = int(np.argmin(np.prod(high - low, axis=0)))

    middle, half = (high + low)[:, best] / 2, (high - low)[:, best] / 2
    center = middle[0] * along[best] + middle[1] * across[best]
    if half[0] >= half[1]:
        return Rectangle(center, along[best], half)
    return Rectangle(center, across[best], half[::-1])


@dataclass(frozen=True)
class FramedPlanes:
    """H planes, the points x with normal . x = offset, and the frames around their panes.

    Attributes:
        normals: [H, 3] unit normals.
        offsets: [H] signed distances of the planes from the origin.
        frames: [H] heights of the frames above the glass, world units.
    """

    normals: Array
    offsets: Array
    frames: Array

    def __len__(self) -> int:
        return len(self.offsets)

    def distances(self, points: Array) -> Array:
        """[H, N] signed distances of points [N, 3]."""
        return self.normals @ points.T - self.offsets[:, None]

    def select(self, index: NDArray[np.int64]) -> FramedPlanes:
        """The planes at `index`."""
        return FramedPlanes(self.normals[index], self.offsets[index], self.frames[index])


def join_planes(parts: Sequence[FramedPlanes]) -> FramedPlanes:
    """The planes of several sets, concatenated."""
    normals = np.concatenate([part.normals for part in parts])
    offsets = np.concatenate([part.offsets for part in parts])
    return FramedPlanes(normals, offsets, np.concatenate([part.frames for part in parts]))


def in_plane_axes(planes: FramedPlanes) -> tuple[Array, Array]:
    """Two unit vectors [H, 3] per plane, perpendicular to its normal and to each other."""
    first = np.cross(planes.normals, np.eye(3)[np.argmin(np.abs(planes.normals), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(planes.normals, first)


def random_planes(points: Array, count: int, rng: np.random.Generator) -> FramedPlanes:
    """Planes, without frames, through random triplets of points [N, 3]. Nearly collinear triplets are dropped.

    Args:
        points: [N, 3] at least three positions.
        count: number of triplets.
        rng: source of randomness.
    """
    a, b, c = points[(len(points) * rng.random((3, count))).astype(np.int64)]
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    # A nearly collinear triplet does not determine the tilt of a plane about its line.
    spread = np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1)
    usable = area > 0.1 * np.maximum(spread, np.finfo(np.float64).tiny)
    normals = normals[usable] / area[usable, None]
    return FramedPlanes(normals, np.einsum("hd,hd->h", normals, a[usable]), np.zeros(len(normals)))


Mask = NDArray[np.bool_]

LEAST_HALF_WIDTH = 0.005
"""Half width below which a part of a mask is treated as an artefact, in image diagonals."""
EDGE_SMOOTHING = 0.005
"""Standard deviation of the Gaussian that smooths a mask to find the direction of its edge, in image diagonals."""


@dataclass(frozen=True)
class PaneView:
    """Mask of one pane in one annotated view, with its edge.

    Attributes:
        cam_from_world: [4, 4] rigid transform, world to camera.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        mask: [H, W] true on the pane.
        hidden: [H, W] true on other panes, behind which this one may continue.
        distance: [H, W] distance in pixels from a pixel's centre to the edge of the mask, positive inside. Where the
            mask leaves the image there is no edge, because the pane continues.
        edge: [E, 2] points (x, y) half-way between a pixel on the pane and a neighbour off it.
        outward: [E, 2] unit vectors normal to the edge, pointing away from the pane.
        name: of the photograph, for messages.
    """

    cam_from_world: Array
    intrinsics: Array
    mask: Mask
    hidden: Mask
    distance: Array
    edge: Array
    outward: Array
    name: str = ""

    @property
    def center(self) -> Array:
        """[3] camera centre in the world."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    @cached_property
    def middle(self) -> Array:
        """[1, 2] middle of the mask's pixels (medians of x and of y)."""
        row, column = np.nonzero(self.mask)
        return np.array([[np.median(column) + 0.5, np.median(row) + 0.5]])

    @property
    def diagonal(self) -> float:
        """Length of the image diagonal in pixels."""
        return float(np.hypot(*self.mask.shape))

    def directions(self, pixels: Array) -> Array:
        """[P, 3] world directions of the rays through pixel positions [P, 2], with z = 1 in the camera's frame."""
        fx, fy, cx, cy = self.intrinsics
        in_camera = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], axis=1)
        return in_camera @ self.cam_from_world[:3, :3]

    def line_plane_normals(self, pixels: Array, outward: Array) -> Array:
        """[P, 3] unit normals, in world axes, of the planes through the camera centre and lines in the image.

        Args:
            pixels: [P, 2] a point of each line.
            outward: [P, 2] unit vectors normal to the lines, on the side that the plane normals point to.
        """
        fx, fy, cx, cy = self.intrinsics
        a, b = outward[:, 0] * fx, outward[:, 1] * fy
        c = -(a * (pixels[:, 0] - cx) / fx + b * (pixels[:, 1] - cy) / fy)
        in_camera = np.stack([a, b, c], axis=1)
        return in_camera / np.linalg.norm(in_camera, axis=1, keepdims=True) @ self.cam_from_world[:3, :3]

    def project(self, points: Array) -> tuple[Array, Mask]:
        """Pixel positions [..., 2] of world points [..., 3], and [...] bool: points inside the image."""
        fx, fy, cx, cy = self.intrinsics
        # Each coordinate is contiguous in memory, because this runs for millions of points.
        x, y, depth = self.cam_from_world[:3, :3] @ points.reshape(-1, 3).T + self.cam_from_world[:3, 3:]
        scale = 1 / np.where(depth > 0, depth, np.inf)
        x, y = fx * x * scale + cx, fy * y * scale + cy
        height, width = self.mask.shape
        inside = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return np.stack([x, y], axis=-1).reshape(*points.shape[:-1], 2), inside.reshape(points.shape[:-1])

    def covers(self, pixels: Array, inside: Mask | bool = True) -> Mask:
        """[...] bool: pixel positions [..., 2] on the pane; false where `inside` is false."""
        return inside & self._sample(self.mask, pixels, inside)

    def is_unoccluded(self, pixels: Array, inside: Mask | bool = True) -> Mask:
        """[...] bool: pixel positions [..., 2] that no other pane covers; false where `inside` is false."""
        return inside & ~self._sample(self.hidden, pixels, inside)

    def _sample(self, image: Mask, pixels: Array, inside: Mask | bool) -> Mask:
        """[...] values of an image at pixel positions [..., 2]; arbitrary where `inside` is false."""
        column, row = (np.where(inside, pixels[..., axis], 0).astype(np.int64) for axis in (0, 1))
        return image.ravel()[row * image.shape[1] + column]

    def edge_distances(self, pixels: Array) -> Array:
        """[P] signed distance to the mask's edge at pixel positions [P, 2], interpolated."""
        centred = pixels[:, ::-1].T - 0.5
        from scipy import ndimage

        sampled: Array = ndimage.map_coordinates(self.distance, centred, order=1, mode="nearest")
        return sampled

    def pixel_grid(self, count: int) -> Array:
        """[P, 2] about `count` pixel positions spread evenly over the image."""
        height, width = self.mask.shape
        step = max(np.sqrt(height * width / count), 1.0)
        x, y = np.meshgrid(np.arange(step / 2, width, step), np.arange(step / 2, height, step))
        return np.stack([x.ravel(), y.ravel()], axis=1)


def cameras_of(views: Sequence[PaneView]) -> Cameras:
    """The cameras of at least one view, stacked."""
    return Cameras(
        np.stack([view.cam_from_world for view in views]),
        np.stack([view.center for view in views]),
        np.stack([view.intrinsics for view in views]),
        np.array([view.mask.shape for view in views]),
    )


def pane_view(camera: Camera, labels: Tensor, label: int, *, name: str = "") -> PaneView:
    """One pane of one annotated view.

    Args:
        camera: the view's camera.
        labels: [H, W] integer label image, of the camera's size.
        label: of the pane.
        name: of the photograph, for messages.

    Raises:
        ValueError: the label image and the camera differ in size.
    """
    if tuple(labels.shape) != (camera.height, camera.width):
        raise ValueError(
            f"a mask of shape {tuple(labels.shape)} belongs to a camera of {camera.height} x {camera.width} pixels; "
            "resize both the same way"
        )
    image = labels.cpu().numpy()
    mask = _without_slivers(image == label)
    edge = _edge_points(mask)
    return PaneView(
        cam_from_world=_to_numpy(camera.cam_from_world),
        intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        mask=mask,
        hidden=~mask & (image != label) & (image != 0),
        distance=_signed_distance(mask),
        edge=edge,
        outward=_outward_normals(mask, edge),
        name=name,
    )


WIDEST_GAP, LEAST_FILLED = 0.04, 0.01
"""Maximum width of gaps that are filled in a mask, in image diagonals, and their minimum share of the mask."""


GAP_DETECTION_DIAGONAL = 500
"""Diagonal in pixels to which a mask is subsampled to detect gaps; closing those of 12 megapixels takes ten seconds."""


def without_gaps(view: PaneView) -> PaneView:
    """The view with narrow gaps in its mask filled, such as those of occluding objects; unchanged if it has none."""
    step = max(int(view.diagonal / GAP_DETECTION_DIAGONAL), 1)
    coarse = view.mask[::step, ::step]
    if not _is_larger(_close_gaps(coarse), coarse):
        return view
    mask = view.mask | (_close_gaps(view.mask) & ~view.hidden)
    if not _is_larger(mask, view.mask):
        return view
    edge = _edge_points(mask)
    return replace(view, mask=mask, distance=_signed_distance(mask), edge=edge, outward=_outward_normals(mask, edge))


def _is_larger(mask: Mask, other: Mask) -> bool:
    return bool(mask.sum() >= (1 + LEAST_FILLED) * other.sum())


def _close_gaps(mask: Mask) -> Mask:
    """The mask after morphological closing, by a disk whose radius is half the maximum width of a gap."""
    from scipy import ndimage

    reach = round(WIDEST_GAP / 2 * float(np.hypot(*mask.shape))) + 1
    box = _bounding_box(mask, 2 * reach + 1)
    padded = np.pad(mask[box], 2 * reach, mode="edge")
    widened = ndimage.distance_transform_edt(~padded) < reach
    closed = np.zeros_like(mask)
    closed[box] = (ndimage.distance_transform_edt(widened) >= reach)[2 * reach : -2 * reach, 2 * reach : -2 * reach]
    return closed


def _to_numpy(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy().astype(np.float64)


def _without_slivers(mask: Mask) -> Mask:
    """The mask without parts that are only a few pixels wide.

    Label images that were resized or saved with interpolation have a line of label 1 around label 2.
    """
    from scipy import ndimage

    box, kept = _bounding_box(mask, 1), np.zeros_like(mask)
    parts, count = ndimage.label(mask[box])
    half_widths = ndimage.maximum(_signed_distance(mask[box]), parts, index=np.arange(count + 1))
    wide = half_widths > LEAST_HALF_WIDTH * np.hypot(*mask.shape)
    wide[0] = False
    kept[box] = wide[parts]
    return kept


def _signed_distance(mask: Mask) -> Array:
    """[H, W] distance to the mask's edge in pixels, positive inside."""
    if mask.all() or not mask.any():
        return np.full(mask.shape, np.hypot(*mask.shape) if mask.all() else -np.hypot(*mask.shape))
    # The edge is half a pixel closer than the nearest pixel centre beyond it.
    from scipy import ndimage

    distance: Array = 0.5 - ndimage.distance_transform_edt(~mask)
    box = _bounding_box(mask, 1)  # Holds the nearest outside pixel of each pixel inside.
    inside = ndimage.distance_transform_edt(mask[box])
    distance[box] = np.where(mask[box], inside - 0.5, distance[box])
    return distance


def _bounding_box(mask: Mask, margin: int) -> tuple[slice, slice]:
    """Rows and columns of the bounding box of a mask, extended by a margin on every side; all if the mask is empty."""
    if not mask.any():
        return slice(None), slice(None)
    found = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    first, second = (
        slice(max(int(at[0]) - margin, 0), min(int(at[-1]) + 1 + margin, size))
        for at, size in zip(found, mask.shape, strict=True)
    )
    return first, second


def _edge_points(mask: Mask) -> Array:
    row, column = np.nonzero(mask[:, 1:] != mask[:, :-1])
    vertical = np.stack([column + 1.0, row + 0.5], axis=1)
    row, column = np.nonzero(mask[1:] != mask[:-1])
    horizontal = np.stack([column + 0.5, row + 1.0], axis=1)
    return np.concatenate([vertical, horizontal])


SMOOTHING_RADIUS = 4.0
"""Radius in standard deviations at which the Gaussian that smooths a mask is truncated."""


def _outward_normals(mask: Mask, edge: Array) -> Array:
    """[E, 2] unit vectors along the negative gradient of the smoothed mask at its edge points."""
    from scipy import ndimage

    sigma = EDGE_SMOOTHING * np.hypot(*mask.shape)
    box = _bounding_box(mask, 2 * int(SMOOTHING_RADIUS * sigma + 2))
    smooth = ndimage.gaussian_filter(mask[box].astype(np.float64), sigma, mode="nearest", truncate=SMOOTHING_RADIUS)
    positions = edge[:, ::-1].T - 0.5 - np.array([[at.start or 0] for at in box])
    gradients = [ndimage.map_coordinates(-np.gradient(smooth, axis=axis), positions, order=1) for axis in (1, 0)]
    outward = np.stack(gradients, axis=1)
    return outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), np.finfo(np.float64).tiny)


def pane_views(
    annotations: Sequence[tuple[Camera, Tensor]],
    label: int,
    *,
    most_views: int = 12,
    names: Sequence[str] | None = None,
) -> list[PaneView]:
    """Annotated views that show a pane, ignoring parts of it that are only a few pixels wide.

    Args:
        annotations: cameras and their label images [H, W].
        label: of the pane.
        most_views: maximum number of views. If every photograph has a mask, views that show much of the pane from
            positions far apart are sufficient.
        names: of the photographs; annotations are numbered from 1 if None.
    """
    centers = np.array([_to_numpy(camera.center) for camera, _ in annotations])
    shares = np.array([float((labels == label).double().mean()) for _, labels in annotations])
    chosen = _select_far_apart(centers, shares, most_views)
    names = names or [f"annotation {number}" for number in range(1, len(annotations) + 1)]
    views = (pane_view(*annotations[index], label, name=names[index]) for index in sorted(chosen))
    return [view for view in views if view.mask.any()]


def _select_far_apart(positions: Array, values: Array, count: int) -> list[int]:
    """Up to `count` indices of positive values, greedily by value times distance from those already chosen."""
    chosen: list[int] = []
    distance = np.ones(len(values))
    while len(chosen) < min(count, int((values > 0).sum())):
        # Views from one position have distance zero; the small constant still selects the largest value among them.
        scores = values * (distance + 1e-9)
        scores[chosen] = 0
        chosen.append(int(np.argmax(scores)))
        nearest = np.linalg.norm(positions - positions[chosen[-1]], axis=1)
        distance = nearest if len(chosen) == 1 else np.minimum(distance, nearest)
    return chosen


CANDIDATE_AGREEMENT = 0.5
"""Minimum share, of the views that contain a point, in which it lies along the edge; others may show it occluded."""


def plane_candidates(points: Array, views: Sequence[PaneView], *, band: float) -> NDArray[np.bool_]:
    """[N] bool: points along the pane's edge (TR-Gaussians, Appendix A, steps 1 and 2).

    A point on the frame projects close to the mask's edge in every view; a point in front of or behind it may do so in
    one view but not in others. So the views vote.

    Args:
        points: [N, 3] world positions.
        views: annotated views of the pane.
        band: half width of the band along the mask's edge, as a share of the image diagonal.
    """
    votes, inside_count = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        pixels, inside = view.project(points)
        votes[inside] += np.abs(view.edge_distances(pixels[inside])) <= band * view.diagonal
        inside_count += inside
    return (votes >= min(2, len(views))) & (votes >= CANDIDATE_AGREEMENT * inside_count)


RAYS_PER_VIEW = 400
"""Number of pixels of each view that are mapped into the others."""
UNKNOWN_WEIGHT = 0.05
"""Weight of pixels that leave the other image; it penalises planes on which hardly anything can be compared."""


def intersect_rays(planes: FramedPlanes, origin: Array, directions: Array) -> tuple[Array, Mask]:
    """Intersections [H, P, 3] of rays with planes, and [H, P] bool: those in front of the origin.

    Args:
        planes: H planes.
        origin: [3] where all rays start.
        directions: [P, 3] their directions.
    """
    slope = planes.normals @ directions.T
    height = planes.offsets - planes.normals @ origin
    along = height[:, None] / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    hit = along > 0
    return origin + np.where(hit, along, 0)[..., None] * directions, hit


def mask_agreement(planes: FramedPlanes, views: Sequence[PaneView], *, pixels_per_view: int = RAYS_PER_VIEW) -> Array:
    """[H] agreement of the masks on each plane: intersection over union, pooled over pairs of views.

    Args:
        planes: hypotheses.
        views: annotated views of one pane, at least two.
        pixels_per_view: number of rays from each view.
    """
    both, either = _overlaps(planes, views, pixels_per_view)
    agreement: Array = both.sum(axis=(1, 2)) / np.maximum(either.sum(axis=(1, 2)), 1)
    return agreement


def agreement_per_view(plane: FramedPlanes, views: Sequence[PaneView]) -> Array:
    """[V] agreement of the mask of each view with those of all others on one plane; as in `mask_agreement`."""
    both, either = (pairs[0] + pairs[0].T for pairs in _overlaps(plane, views, RAYS_PER_VIEW))
    agreement: Array = both.sum(axis=1) / np.maximum(either.sum(axis=1), 1)
    return agreement


def _overlaps(planes: FramedPlanes, views: Sequence[PaneView], pixels_per_view: int) -> tuple[Array, Array]:
    """Pixel counts of the intersection and the union of the masks of two views; [H, V, V], from and to."""
    grids = [view.pixel_grid(pixels_per_view) for view in views]
    seen = [pixels[view.is_unoccluded(pixels)] for view, pixels in zip(views, grids, strict=True)]
    rays = Rays(
        np.repeat(np.arange(len(views)), [len(pixels) for pixels in seen]),
        np.concatenate([view.directions(pixels) for view, pixels in zip(views, seen, strict=True)]),
        np.concatenate([view.covers(pixels) for view, pixels in zip(views, seen, strict=True)]),
    )
    masks, hidden = [view.mask for view in views], [view.hidden for view in views]
    return overlaps(planes.normals, planes.offsets, cameras_of(views), rays, masks, hidden, UNKNOWN_WEIGHT)
