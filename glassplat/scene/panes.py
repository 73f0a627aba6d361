"""Panes as learnable rectangles (TR-Gaussians, Section III-A2), and visibility through them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from glassplat.scene import check_tensor_names, logit
from glassplat.scene.camera import LEAST_SINE, Camera, constant
from glassplat.scene.gaussians import check_rows

HIGHEST_LABEL = 255
"""Labels are stored in a byte."""
PANE_TENSORS = ("centers", "raw_normals", "logit_reflectances", "log_transmittances")
LONGEST_LIST = 3
"""Consecutive labels that messages list individually."""


def name_labels(labels: Iterable[int]) -> str:
    """Sorted labels as text: "2, 3, 5", "1 to 24, 30"."""
    runs: list[list[int]] = []
    for label in sorted(set(labels)):
        if runs and label == runs[-1][-1] + 1:
            runs[-1].append(label)
        else:
            runs.append([label])
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > LONGEST_LIST else ", ".join(map(str, run)) for run in runs)


@dataclass(frozen=True, eq=False)
class Planes:
    """K reflecting rectangles, one per pane.

    The rectangle's size and in-plane orientation get no gradient (the hit mask is piecewise
    constant in them); they are set large enough to cover the pane, and the rendered mask cuts
    the exact shape.

    Attributes:
        centers: [K, 3] a point on each plane, the rectangle's middle; world units.
        raw_normals: [K, 3] normals before normalisation.
        logit_reflectances: [K] base reflectance R0 before the sigmoid.
        tangents: [K, 3] direction of the rectangle's first side; made orthogonal to the normal in use.
        half_sizes: [K, 2] half the side lengths along tangent and bitangent; world units.
        labels: pane label of each plane, 1 to 255; masks have labels up to 64.
        mirrors: labels of mirrors, which transmit nothing; their base reflectance gets no gradient.
        log_transmittances: [K, 3] logarithm of the transmitted share of the unreflected red, green and blue light. None
            if all panes are clear.
    """

    centers: Tensor
    raw_normals: Tensor
    logit_reflectances: Tensor
    tangents: Tensor
    half_sizes: Tensor
    labels: tuple[int, ...]
    mirrors: tuple[int, ...] = ()
    log_transmittances: Tensor | None = None

    def __post_init__(self) -> None:
        rows = dict.fromkeys(self.tensors(), ((3,),)) | {"logit_reflectances": ((),), "half_sizes": ((2,),)}
        check_rows(self.tensors(), len(self.labels), rows)
        if wrong := [label for label in self.labels if not 1 <= label <= HIGHEST_LABEL]:
            raise ValueError(f"there are planes with the labels {wrong}; expected 1 to {HIGHEST_LABEL}")
        if len(set(self.labels)) < len(self.labels):
            raise ValueError(f"there are planes with the labels {self.labels}; expected another one for each plane")
        if not set(self.mirrors) <= set(self.labels):
            raise ValueError(f"mirrors {self.mirrors} are not all among the plane labels {self.labels}")

    def __len__(self) -> int:
        return len(self.labels)

    def __repr__(self) -> str:
        reflectances = [round(float(value), 3) for value in self.logit_reflectances.detach().sigmoid()]
        return f"Planes(labels={self.labels}, mirrors={self.mirrors}, R0={reflectances})"

    @property
    def normals(self) -> Tensor:
        """[K, 3] unit normals."""
        return torch.nn.functional.normalize(self.raw_normals, dim=-1)

    @property
    def base_reflectances(self) -> Tensor:
        """[K] reflectance at normal incidence R0, in (0, 1)."""
        logits = self.logit_reflectances
        if self.mirrors:
            logits = torch.where(self.are_mirrors, logits.detach(), logits)
        return torch.sigmoid(logits)

    @property
    def are_mirrors(self) -> Tensor:
        """[K] bool, true for mirrors; shared between calls, do not modify it."""
        return constant(tuple(label in self.mirrors for label in self.labels), torch.bool, self.centers.device)

    @property
    def transmittances(self) -> Tensor | None:
        """[K, 3] transmitted share of red, green and blue light; None if all panes are clear.

        Training keeps it in (0, 1]. It is not clamped here, which would remove the gradient outside.
        """
        return None if self.log_transmittances is None else self.log_transmittances.exp()

    def that_may_tint(self) -> Planes:
        """The planes with trainable transmittances, initially clear."""
        clear = self.centers.new_zeros(len(self), 3)
        return self if self.log_transmittances is not None else replace(self, log_transmittances=clear)

    def axes(self) -> tuple[Tensor, Tensor]:
        """Unit in-plane axes (tangent, bitangent), each [K, 3]; right-handed with the normal."""
        normals = self.normals
        flat = self.tangents - (self.tangents * normals).sum(-1, keepdim=True) * normals
        tangent = torch.nn.functional.normalize(flat, dim=-1)
        return tangent, torch.linalg.cross(normals, tangent)

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        named = {name: getattr(self, name) for name in (*PANE_TENSORS, "tangents", "half_sizes")}
        return {name: tensor for name, tensor in named.items() if tensor is not None}

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> Planes:
        """The planes with some tensors replaced by name."""
        return replace(self, **check_tensor_names(tensors, self.tensors(), "planes"))

    def select(self, rows: Sequence[int]) -> Planes:
        """The planes at the given positions, in that order."""
        index = constant(tuple(rows), torch.int64, self.centers.device)
        chosen = {name: tensor[index] for name, tensor in self.tensors().items()}
        labels = tuple(self.labels[k] for k in rows)
        return Planes(**chosen, labels=labels, mirrors=tuple(label for label in self.mirrors if label in labels))

    def concat(self, other: Planes) -> Planes:
        """These planes and others, in the order of their labels."""
        if (self.log_transmittances is None) != (other.log_transmittances is None):
            return self.that_may_tint().concat(other.that_may_tint())
        mine, theirs = self.tensors(), other.tensors()
        together = Planes(
            **{name: torch.cat([mine[name], theirs[name]]) for name in mine},
            labels=(*self.labels, *other.labels),
            mirrors=(*self.mirrors, *other.mirrors),
        )
        return together.select(sorted(range(len(together)), key=together.labels.__getitem__))

    def to(self, device: torch.device | torch.dtype | str) -> Planes:
        """The same planes on another device, or in another precision."""
        return self.with_tensors({name: tensor.to(device) for name, tensor in self.tensors().items()})

    @staticmethod
    def rectangle(
        center: Sequence[float],
        normal: Sequence[float],
        half_sizes: Sequence[float],
        *,
        tangent: Sequence[float] | None = None,
        label: int = 1,
        base_reflectance: float = 0.5,
    ) -> Planes:
        """A single plane.

        Args:
            center: [3] centre, world units.
            normal: [3] of any length.
            half_sizes: half its sides along tangent and bitangent, world units.
            tangent: [3] direction of its first side; any direction in the plane if None.
            label: label of the pane, 1 to 255.
            base_reflectance: R0, between 0 and 1; 0.08 for clear glass.

        Raises:
            ValueError: a value is not finite, a size is not positive, a direction has length 0, or the label or R0 is
                out of range.
        """
        middle, across, half = (
            torch.tensor(list(values), dtype=torch.float32) for values in (center, normal, half_sizes)
        )
        if tangent is None:
            axis = torch.eye(3, dtype=torch.float32)[int(across.abs().argmin())]
        else:
            axis = torch.tensor(list(tangent), dtype=torch.float32)
        shapes = [tuple(vector.shape) for vector in (middle, across, axis, half)]
        if shapes != [(3,), (3,), (3,), (2,)]:
            raise ValueError(f"center, normal, tangent and half_sizes have the shapes {shapes}; expected 3, 3, 3 and 2")
        numbers = torch.cat([middle, across, axis, half])
        if not bool(numbers.isfinite().all()) or not bool((half > 0).all()):
            raise ValueError(f"a pane of {center}, {normal}, {half_sizes}; expected finite numbers, sizes above 0")
        if float(torch.linalg.cross(across, axis).norm()) <= LEAST_SINE * float(across.norm() * axis.norm()):
            raise ValueError(f"a pane with the normal {normal} and the tangent {tangent}; expected two directions")
        if not 0 < base_reflectance < 1:
            raise ValueError(f"a pane with an R0 of {base_reflectance}; expected a number between 0 and 1")
        logits = torch.tensor([logit(base_reflectance)], dtype=torch.float32)
        return Planes(middle[None], across[None], logits, axis[None], half[None], (label,))

    @staticmethod
    def empty() -> Planes:
        """An empty set of planes."""
        return Planes(
            torch.zeros(0, 3, dtype=torch.float32),
            torch.zeros(0, 3, dtype=torch.float32),
            torch.zeros(0, dtype=torch.float32),
            torch.zeros(0, 3, dtype=torch.float32),
            torch.zeros(0, 2, dtype=torch.float32),
            (),
        )


LARGEST_ANGLE = math.radians(1.0)
"""Maximum angle between the normals of coplanar panes."""
LARGEST_OFFSET = 0.02
"""Maximum distance of one pane's centre from the other's plane, as a share of the longer half side."""


@torch.no_grad()
def coplanar_groups(planes: Planes, rows: Sequence[int]) -> list[list[int]]:
    """Groups of coplanar panes (transitively), each with its largest pane first.

    Args:
        planes: the panes.
        rows: positions of the panes to group.

    Returns:
        Groups that partition the rows, in order of their first rows.
    """
    groups = connected_components(rows, lambda one, other: _are_coplanar(planes, one, other))
    areas = planes.half_sizes.prod(dim=1)
    return [sorted(group, key=lambda row: (-float(areas[row]), row)) for group in groups]


def connected_components(rows: Sequence[int], are_linked: Callable[[int, int], bool]) -> list[list[int]]:
    """Connected components of linked rows, in order of their smallest rows."""
    groups: list[list[int]] = []
    for row in rows:
        linked = [group for group in groups if any(are_linked(row, other) for other in group)]
        component = [*(other for group in linked for other in group), row]
        groups = sorted([*(group for group in groups if group not in linked), component], key=min)
    return groups


def _are_coplanar(planes: Planes, one: int, other: int) -> bool:
    normals, between = planes.normals[[one, other]], planes.centers[one] - planes.centers[other]
    angle = torch.linalg.cross(normals[0], normals[1]).norm().clamp(max=1).asin()
    offset = (normals @ between).abs().amax()
    return bool(angle <= LARGEST_ANGLE) and bool(offset <= LARGEST_OFFSET * planes.half_sizes[[one, other]].amax())


def rectangle_offsets(points: Tensor, planes: Planes) -> Tensor:
    """[N, K, 3] distances of points [N, 3] beyond the sides of each rectangle, and from its plane; world units.

    The norm of a row is the distance from the rectangle.
    """
    offsets = points[:, None] - planes.centers
    along = torch.stack([(offsets * axis).sum(-1) for axis in planes.axes()], dim=-1)
    outside = (along.abs() - planes.half_sizes).clamp(min=0)
    across = (offsets * planes.normals).sum(-1, keepdim=True)
    return torch.cat([outside, across], dim=-1)


@torch.no_grad()
def nearest_panes(points: Tensor, planes: Planes) -> Tensor:
    """[N] position in `planes` of the rectangle nearest to each of the points [N, 3]."""
    return rectangle_offsets(points, planes).square().sum(-1).argmin(dim=1)


def crosses_pane(points: Tensor, planes: Planes, camera_center: Tensor) -> Tensor:
    """[N] bool: true if the segment from `camera_center` to the point crosses a pane."""
    normals = planes.normals
    camera_distance = ((camera_center - planes.centers) * normals).sum(-1)
    distances = points @ normals.T - (planes.centers * normals).sum(-1)
    behind = camera_distance * distances < 0
    share = torch.where(behind, camera_distance / (camera_distance - distances), 0)
    inside = behind
    for axis, half in zip(planes.axes(), planes.half_sizes.T, strict=True):
        start = ((camera_center - planes.centers) * axis).sum(-1)
        end = points @ axis.T - (planes.centers * axis).sum(-1)
        inside = inside & ((start + share * (end - start)).abs() <= half)
    return inside.any(dim=1)


def nearest_pixels(positions: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Row and column [N] of the pixels nearest to positions [N, 2] inside or outside an image."""
    column, row = positions.nan_to_num().unbind(dim=1)
    return row.clamp(0, camera.height - 1).long(), column.clamp(0, camera.width - 1).long()


def in_image(points: Tensor, camera: Camera) -> Tensor:
    """[N] bool: points inside the image of a camera, occluded or not."""
    pixels, depths = camera.project(points)
    size = pixels.new_tensor([camera.width, camera.height])
    return (depths > 0) & ((pixels >= 0) & (pixels <= size)).all(dim=1)
