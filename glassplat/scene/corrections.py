"""Per-photograph corrections: exposure, camera pose, and the photographer's frame."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import ClassVar, Self

import torch
from torch import Tensor

from glassplat.scene import check_tensor_names
from glassplat.scene.camera import Camera, constant


def neighbour_rows(name: str, names: Sequence[str]) -> list[int]:
    """Rows of the neighbours of `name` in sorted `names`; only one at either end.

    Numbers in names are sorted numerically. Photographs of other folders are not neighbours, since their order in time
    is unknown; the list may be empty.
    """
    folder, key = PurePosixPath(name).parent, natural_sort_key(name)
    same_folder = [row for row, known in enumerate(names) if PurePosixPath(known).parent == folder and known != name]
    before = [row for row in same_folder if natural_sort_key(names[row]) < key]
    after = [row for row in same_folder if natural_sort_key(names[row]) > key]
    return [
        *([max(before, key=lambda row: natural_sort_key(names[row]))] if before else []),
        *([min(after, key=lambda row: natural_sort_key(names[row]))] if after else []),
    ]


def natural_sort_key(name: str) -> tuple[list[tuple[int, str]], str]:
    """Sort key of names: their parts without suffix, numbers by value, so that `a.jpg` comes before `a1.jpg`."""
    parts = re.findall(r"\d+|\D+", str(PurePosixPath(name).with_suffix("")))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], name


@dataclass(frozen=True)
class PerPhotograph:
    """Base class of per-photograph values.

    Attributes:
        values: [V, ...] zero for photographs without a correction.
        names: names of the V photographs.
    """

    TENSOR: ClassVar[str]
    """Name of the values."""
    SHAPE: ClassVar[tuple[int, ...]]
    """Shape of the values of one photograph."""

    values: Tensor
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        expected = [len(self.names), *self.SHAPE]
        if list(self.values.shape) != expected:
            raise ValueError(
                f"{self.TENSOR} has shape {list(self.values.shape)} for {len(self.names)} photographs; expected "
                f"{expected}"
            )

    def __len__(self) -> int:
        """Number of photographs."""
        return len(self.names)

    def values_of(self, name: str) -> Tensor | None:
        """Values of a photograph; None if it has none."""
        return self.values[self.names.index(name)] if name in self.names else None

    def interpolate(self, name: str) -> Self:
        """The corrections with values for a missing photograph: the mean of its neighbours' by name.

        Unchanged if the photograph has values, or no neighbours.
        """
        rows = [] if name in self.names else neighbour_rows(name, self.names)
        if not rows:
            return self
        mean = self.values[rows].mean(dim=0, keepdim=True)
        return replace(self, values=torch.cat([self.values, mean]), names=(*self.names, name))

    def covers_any(self, names: Iterable[str]) -> bool:
        """Return whether any of these photographs has values of its own or of neighbours."""
        return any(name in self.interpolate(name).names for name in names)

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {self.TENSOR: self.values}

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> Self:
        """The corrections with tensors replaced by name."""
        known = check_tensor_names(tensors, self.tensors(), "these corrections")
        return replace(self, values=known.get(self.TENSOR, self.values))

    def to(self, device: torch.device | torch.dtype | str) -> Self:
        """The same on another device, or in another precision."""
        return replace(self, values=self.values.to(device))

    @classmethod
    def neutral(cls, names: tuple[str, ...] = ()) -> Self:
        """Neutral corrections of all photographs."""
        return cls(torch.zeros(len(names), *cls.SHAPE, dtype=torch.float32), names)


@dataclass(frozen=True)
class Exposures(PerPhotograph):
    """For each photograph, the affine map from scene colours to its own: c' = c + A c + b, sRGB.

    Exposure and white balance vary between photographs. In sRGB, a power of radiance, both are approximately factors
    on the channels.

    `values` are [V, 3, 4] A and b; zero for photographs with the colours of the scene.
    """

    TENSOR = "affine"
    SHAPE = (3, 4)

    def apply(self, image: Tensor, name: str) -> Tensor:
        """An image [..., 3] of the scene in the colours of a photograph; differentiable in both."""
        own = self.values_of(name)
        if own is None:
            return image
        return image @ (torch.eye(3, dtype=image.dtype, device=image.device) + own[:, :3].T) + own[:, 3]

    def change_of(self, color: tuple[float, float, float], name: str) -> Tensor | None:
        """[3] c' - c of one colour in a photograph; None if the photograph has no values."""
        own = self.values_of(name)
        return None if own is None else own[:, :3] @ constant(color, own.dtype, own.device) + own[:, 3]

    def apply_inverse(self, photo: Tensor, name: str) -> Tensor:
        """A photograph [..., 3] in the colours of the scene: the inverse of `apply`."""
        own = self.values_of(name)
        if own is None:
            return photo
        own = own.to(photo)
        return (photo - own[:, 3]) @ torch.linalg.inv(torch.eye(3, dtype=torch.float32).to(photo) + own[:, :3].T)


@dataclass(frozen=True)
class PoseCorrections(PerPhotograph):
    """For each photograph, a small motion of its camera about its own centre, in axes parallel to the world's.

    cam_from_world = [R | t] becomes exp(twist turned by R) cam_from_world. In these axes, a common shift of all
    cameras is the mean of their twists, and the motion of a camera between two others is about the mean of theirs. A
    common rotation about a point is not a common twist, because it shifts each camera differently.

    `values` are [V, 6] twists: rotation vectors in radians, and translations in scene extents; zero for a camera that
    stays. Both are small numbers in any units.
    """

    TENSOR = "twists"
    SHAPE = (6,)

    def correct(self, camera: Camera, name: str, extent: float) -> Camera:
        """The corrected camera of a photograph; differentiable in the twists.

        Args:
            camera: camera of the capture.
            name: name of the photograph.
            extent: extent of the scene, world units.
        """
        twist = self.values_of(name)
        if twist is None:
            return camera
        cam_axes_from_world = camera.cam_from_world[:3, :3].to(twist)
        return moved_camera(camera, (twist.reshape(2, 3) @ cam_axes_from_world.T).reshape(6), extent)


def moved_camera(camera: Camera, twist: Tensor, extent: float) -> Camera:
    """The camera after a motion in its own frame.

    Args:
        camera: camera before the motion.
        twist: [6] rotation vector, radians, and translation, in extents.
        extent: extent of the scene, world units.
    """
    pose = camera.cam_from_world
    return replace(camera, cam_from_world=motion_from_twist(twist, extent).to(pose.dtype) @ pose.to(twist.device))


def motion_from_twist(twist: Tensor, extent: float) -> Tensor:
    """[4, 4] the rigid motion of a twist [6] of `moved_camera`; smooth everywhere, including at zero."""
    x, y, z, *shift = twist.unbind()
    zero = torch.zeros_like(x)
    u, v, w = (extent * along for along in shift)
    rows = [zero, -z, y, u, z, zero, -x, v, -y, x, zero, w, zero, zero, zero, zero]
    found: Tensor = torch.linalg.matrix_exp(torch.stack(rows).reshape(4, 4))
    return found


Direction = tuple[float, float, float]
DEFAULT_UP: Direction = (0.0, -1.0, 0.0)
"""Default up direction, if the cameras do not determine it."""

LEVEL_SHARE = 0.2
"""Weight of the image's horizontal axis, which defines the frame if the camera looks straight up or down."""
TILT_PENALTY = 0.01
"""Regularisation against a degenerate up direction if all cameras look the same way."""
LEAST_AGREEMENT = 0.1
"""Length of a mean of unit vectors below which its direction is undefined."""


def estimate_up(cameras: Sequence[Camera]) -> Direction:
    """Up direction estimated from the cameras: unit, world axes.

    Handheld cameras are pitched, but hardly rolled, so that their x axes are horizontal. The up direction is
    perpendicular to these, with the sign of upright images; if all cameras look the same way, it is that of the mean
    image. If they look straight down with all rolls, it is opposite to their viewing direction.
    """
    rotations = torch.stack([camera.cam_from_world[:3, :3] for camera in cameras]).double().cpu()
    level = rotations[:, 0]
    scatter = level.T @ level / len(cameras) + TILT_PENALTY * torch.eye(3, dtype=torch.float64)
    for axis in (1, 2):
        mean_up = -rotations[:, axis].mean(dim=0)
        if float(mean_up.norm()) > LEAST_AGREEMENT:
            x, y, z = torch.nn.functional.normalize(torch.linalg.solve(scatter, mean_up), dim=0).tolist()
            return (x, y, z)
    return DEFAULT_UP


def world_from_photographer(camera: Camera, up: Direction | None) -> Tensor:
    """[4, 4] the frame of the photographer, at the camera: x to the right, y down, z ahead; differentiable.

    Args:
        camera: OpenCV axes, not mirrored.
        up: unit up direction; None tilts the frame with the camera.
    """
    rotation = camera.cam_from_world[:3, :3].T
    if up is not None:
        rotation = _upright_rotation(rotation, torch.tensor(up, dtype=rotation.dtype, device=rotation.device))
    top = torch.cat([rotation, camera.center[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def _upright_rotation(world_from_cam: Tensor, up: Tensor) -> Tensor:
    """[3, 3] the rotation whose y axis points down and whose z axis is the horizontal viewing direction."""
    right, ahead = world_from_cam[:, 0], world_from_cam[:, 2]
    across = torch.linalg.cross(ahead, up) + LEVEL_SHARE * (right - (right @ up) * up)
    across = torch.nn.functional.normalize(across, dim=0)
    return torch.stack([across, -up, torch.linalg.cross(across, -up)], dim=1)
