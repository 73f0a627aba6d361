"""How far the cameras of photographs are from where they were said to be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from glassplat.scene.camera import Camera
from glassplat.scene.neighbours import neighbours

TRAINABLE = ("twists",)


@dataclass(frozen=True)
class PoseCorrections:
    """For each photograph a small motion of its camera about its own centre, in axes parallel to the world's.

    cam_from_world = [R | t] becomes exp(twist turned by R) cam_from_world. In these axes a motion that all cameras have
    in common is the mean of their twists, and that of a camera between two others the mean of theirs.

    Attributes:
        twists: [V, 6] rotation vector in radians, and translation in scene extents, so that both are small numbers
            whatever the capture's units. Zero for a camera that stays.
        names: of the V photographs; one that is missing keeps its camera.
    """

    twists: Tensor
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        if tuple(self.twists.shape) != (len(self.names), 6):
            raise ValueError(
                f"twists have shape {list(self.twists.shape)} for {len(self.names)} photographs; expected "
                f"[{len(self.names)}, 6]"
            )

    def __len__(self) -> int:
        """Number of photographs."""
        return len(self.names)

    def corrected(self, camera: Camera, name: str, extent: float) -> Camera:
        """The camera of a photograph where it really is; differentiable in the twists.

        Args:
            camera: as the capture says.
            name: of the photograph.
            extent: of the scene, world units.
        """
        if name not in self.names:
            return camera
        twist = self.twists[self.names.index(name)]
        cam_axes_from_world = camera.cam_from_world[:3, :3].to(twist)
        return moved_camera(camera, (twist.reshape(2, 3) @ cam_axes_from_world.T).reshape(6), extent)

    def interpolated(self, name: str) -> PoseCorrections:
        """The same with a motion for a photograph that has none: the mean of its neighbours' in the order of names.

        Itself where the photograph has its own, or no neighbours.
        """
        rows = [] if name in self.names else neighbours(name, self.names)
        if not rows:
            return self
        return PoseCorrections(
            torch.cat([self.twists, self.twists[rows].mean(dim=0, keepdim=True)]), (*self.names, name)
        )

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {"twists": self.twists}

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> PoseCorrections:
        """The same with its tensors replaced by name."""
        unknown = set(tensors) - set(TRAINABLE)
        if unknown:
            raise ValueError(f"unknown tensors {sorted(unknown)}; pose corrections have {sorted(TRAINABLE)}")
        return replace(self, twists=tensors.get("twists", self.twists))

    def to(self, device: torch.device | str) -> PoseCorrections:
        """The same on another device."""
        return replace(self, twists=self.twists.to(device))

    @staticmethod
    def none(names: tuple[str, ...] = ()) -> PoseCorrections:
        """All cameras where they were said to be."""
        return PoseCorrections(torch.zeros(len(names), 6), names)


def moved_camera(camera: Camera, twist: Tensor, extent: float) -> Camera:
    """The camera after a motion in its own frame.

    Args:
        camera: before it.
        twist: [6] rotation vector, radians, and translation, in extents.
        extent: world units.
    """
    pose = camera.cam_from_world
    return replace(camera, cam_from_world=motion(twist, extent).to(pose) @ pose.to(twist.device))


def motion(twist: Tensor, extent: float) -> Tensor:
    """[4, 4] the rigid motion of a twist [6], as `moved_camera` takes it; smooth everywhere, also at zero."""
    x, y, z, *shift = twist.unbind()
    zero = torch.zeros_like(x)
    u, v, w = (extent * along for along in shift)
    rows = [zero, -z, y, u, z, zero, -x, v, -y, x, zero, w, zero, zero, zero, zero]
    found: Tensor = torch.linalg.matrix_exp(torch.stack(rows).reshape(4, 4))
    return found
