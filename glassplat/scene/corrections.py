"""Per-photograph corrections: exposure, camera pose, and the photographer's frame."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import ClassVar, Self

import torch
from torch import Tensor

from glassplat.scene import among_known
from glassplat.scene.camera import Camera


def neighbours(name: str, names: Sequence[str]) -> list[int]:
    """Rows of the last of `names` before `name` and of the first after it; one of them at an end.

    Numbers in names count as numbers: 9 comes before 10. Photographs of other folders are no neighbours, since nobody
    knows when they were taken; the list is empty where there are no others.
    """
    folder, here = PurePosixPath(name).parent, in_order(name)
    beside = [row for row, known in enumerate(names) if PurePosixPath(known).parent == folder and known != name]
    before = [row for row in beside if in_order(names[row]) < here]
    after = [row for row in beside if in_order(names[row]) > here]
    return [
        *([max(before, key=lambda row: in_order(names[row]))] if before else []),
        *([min(after, key=lambda row: in_order(names[row]))] if after else []),
    ]


def in_order(name: str) -> tuple[list[tuple[int, str]], str]:
    """Sort key of names: their parts without suffix, numbers by value, so that `a.jpg` comes before `a1.jpg`."""
    parts = re.findall(r"\d+|\D+", str(PurePosixPath(name).with_suffix("")))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], name


@dataclass(frozen=True)
class ByPhotograph:
    """Values for each of V photographs; a subclass says what they mean.

    Attributes:
        values: [V, ...] all zero for a photograph that is taken as it is.
        names: of the V photographs.
    """

    TENSOR: ClassVar[str]
    """Name of the values."""
    SHAPE: ClassVar[tuple[int, ...]]
    """Of those of one photograph."""

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

    def of(self, name: str) -> Tensor | None:
        """Values of a photograph; None for one that has none and is taken as it is."""
        return self.values[self.names.index(name)] if name in self.names else None

    def interpolate(self, name: str) -> Self:
        """The same with values for a photograph that has none: the mean of its neighbours' in the order of names.

        Itself where the photograph has its own, or no neighbours.
        """
        rows = [] if name in self.names else neighbours(name, self.names)
        if not rows:
            return self
        mean = self.values[rows].mean(dim=0, keepdim=True)
        return replace(self, values=torch.cat([self.values, mean]), names=(*self.names, name))

    def reaches(self, names: Iterable[str]) -> bool:
        """Return whether any of these photographs has values, its own or its neighbours'."""
        return any(name in self.interpolate(name).names for name in names)

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {self.TENSOR: self.values}

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> Self:
        """The same with its tensors replaced by name."""
        known = among_known(tensors, self.tensors(), "these corrections")
        return replace(self, values=known.get(self.TENSOR, self.values))

    def to(self, device: torch.device | torch.dtype | str) -> Self:
        """The same on another device, or in another precision."""
        return replace(self, values=self.values.to(device))

    @classmethod
    def neutral(cls, names: tuple[str, ...] = ()) -> Self:
        """All photographs taken as they are."""
        return cls(torch.zeros(len(names), *cls.SHAPE, dtype=torch.float32), names)


@dataclass(frozen=True)
class Exposures(ByPhotograph):
    """For each photograph what makes its colours of those of the scene: c' = c + A c + b, sRGB.

    Cameras change exposure and white balance from one photograph to the next. In sRGB, a power of the radiance, both
    are nearly factors on the channels.

    `values` are [V, 3, 4] A and b; zero for a photograph in the scene's own colours.
    """

    TENSOR = "affine"
    SHAPE = (3, 4)

    def apply(self, image: Tensor, name: str) -> Tensor:
        """An image [..., 3] of the scene in the colours of a photograph; differentiable in both."""
        own = self.of(name)
        if own is None:
            return image
        return image @ (torch.eye(3, dtype=image.dtype, device=image.device) + own[:, :3].T) + own[:, 3]

    def undone(self, photo: Tensor, name: str) -> Tensor:
        """A photograph [..., 3] in the colours of the scene: what `apply` would have made the photograph."""
        own = self.of(name)
        if own is None:
            return photo
        own = own.to(photo)
        return (photo - own[:, 3]) @ torch.linalg.inv(torch.eye(3, dtype=torch.float32).to(photo) + own[:, :3].T)


@dataclass(frozen=True)
class PoseCorrections(ByPhotograph):
    """For each photograph a small motion of its camera about its own centre, in axes parallel to the world's.

    cam_from_world = [R | t] becomes exp(twist turned by R) cam_from_world. In these axes a shift that all cameras have
    in common is the mean of their twists, and the motion of a camera between two others is about the mean of theirs. A
    turn of all cameras about one place is no common twist: it shifts each of them differently.

    `values` are [V, 6] twists: rotation vectors in radians, and translations in scene extents; zero for a camera that
    stays. So both are small numbers whatever the capture's units.
    """

    TENSOR = "twists"
    SHAPE = (6,)

    def correct(self, camera: Camera, name: str, extent: float) -> Camera:
        """The camera of a photograph where it really is; differentiable in the twists.

        Args:
            camera: as the capture says.
            name: of the photograph.
            extent: of the scene, world units.
        """
        twist = self.of(name)
        if twist is None:
            return camera
        cam_axes_from_world = camera.cam_from_world[:3, :3].to(twist)
        return moved_camera(camera, (twist.reshape(2, 3) @ cam_axes_from_world.T).reshape(6), extent)


def moved_camera(camera: Camera, twist: Tensor, extent: float) -> Camera:
    """The camera after a motion in its own frame.

    Args:
        camera: before it.
        twist: [6] rotation vector, radians, and translation, in extents.
        extent: world units.
    """
    pose = camera.cam_from_world
    return replace(camera, cam_from_world=motion(twist, extent).to(pose.dtype) @ pose.to(twist.device))


def motion(twist: Tensor, extent: float) -> Tensor:
    """[4, 4] the rigid motion of a twist [6], as `moved_camera` takes it; smooth everywhere, also at zero."""
    x, y, z, *shift = twist.unbind()
    zero = torch.zeros_like(x)
    u, v, w = (extent * along for along in shift)
    rows = [zero, -z, y, u, z, zero, -x, v, -y, x, zero, w, zero, zero, zero, zero]
    found: Tensor = torch.linalg.matrix_exp(torch.stack(rows).reshape(4, 4))
    return found


Direction = tuple[float, float, float]
DEFAULT_UP: Direction = (0.0, -1.0, 0.0)
"""Of most captures, where no camera tells."""

LEVEL_SHARE = 0.2
"""Of the image's own horizontal axis, which decides where a camera looks straight down or up."""
TILT_PENALTY = 0.01
"""Against an upward direction that only fits because all cameras look the same way."""
LEAST_AGREEMENT = 0.1
"""Length of a mean of unit vectors below which they tell no direction."""


def upward(cameras: Sequence[Camera]) -> Direction:
    """The direction away from the ground, as the cameras tell: unit, world axes.

    Handheld cameras are tilted up and down, but hardly rolled: their x axes are level. Of the directions at right
    angles to these the one along which images stand upright is taken; where all cameras look the same way, that of
    the mean image. Cameras that look straight down, rolled in all directions, look away from it.
    """
    rotations = torch.stack([camera.cam_from_world[:3, :3] for camera in cameras]).double().cpu()
    level = rotations[:, 0]
    spread = level.T @ level / len(cameras) + TILT_PENALTY * torch.eye(3, dtype=torch.float64)
    for axis in (1, 2):
        told = -rotations[:, axis].mean(dim=0)
        if float(told.norm()) > LEAST_AGREEMENT:
            x, y, z = torch.nn.functional.normalize(torch.linalg.solve(spread, told), dim=0).tolist()
            return (x, y, z)
    return DEFAULT_UP


def world_from_photographer(camera: Camera, up: Direction | None) -> Tensor:
    """[4, 4] the frame of whoever holds the camera: its origin, x to the right, y down, z ahead; differentiable.

    Args:
        camera: held; OpenCV axes, not mirrored.
        up: the direction in which people stand, unit; None leans the frame with the camera.
    """
    rotation = camera.cam_from_world[:3, :3].T
    if up is not None:
        rotation = _stood_up(rotation, torch.tensor(up, dtype=rotation.dtype, device=rotation.device))
    top = torch.cat([rotation, camera.center[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def _stood_up(world_from_cam: Tensor, up: Tensor) -> Tensor:
    """[3, 3] the rotation whose y axis points down and whose z axis points where the camera does."""
    right, ahead = world_from_cam[:, 0], world_from_cam[:, 2]
    across = torch.linalg.cross(ahead, up) + LEVEL_SHARE * (right - (right @ up) * up)
    across = torch.nn.functional.normalize(across, dim=0)
    return torch.stack([across, -up, torch.linalg.cross(across, -up)], dim=1)
