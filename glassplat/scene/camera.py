"""Pinhole cameras with OpenCV axes (+x right, +y down, +z forward, pixel centres at +0.5), rotations and mirror
matrices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def synchronises(device: torch.device) -> bool:
    """Return whether reading results from this device synchronises, as on a GPU."""
    return device.type == "cuda"


def to_device(tensor: Tensor, device: torch.device | torch.dtype | str) -> Tensor:
    """The tensor on a device, or in another precision; if it is still on its way, what is computed from it waits."""
    if isinstance(device, torch.dtype) or tensor.device.type != "cpu" or torch.device(device).type != "cuda":
        return tensor.to(device)
    # Asynchronous copies need pinned memory.
    return tensor.pin_memory().to(device, non_blocking=True)


@lru_cache(maxsize=1024)
@torch.inference_mode(False)  # A later call may need gradients.
def constant(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A constant tensor of these numbers or rows, shared between calls; do not modify it."""
    return to_device(torch.tensor(values, dtype=dtype, device="cpu"), device)


LEAST_SINE = 1e-6
"""Minimum sine of the angle between two directions that span a plane, as viewing direction and up."""
LEAST_CROSSING = 1e-3
"""Smallest eigenvalue of the mean of I - d d^T for which lines along d count as crossing."""


def rotation_from_quat(quats: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] in `wxyz` order, normalised here."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)


def quat_from_rotation(rotation: Tensor) -> Tensor:
    """A unit quaternion [4], `wxyz`, of a rotation [3, 3]; float64, on the CPU, without gradients."""
    from scipy.spatial.transform import Rotation  # Slow to import, and rarely needed.

    x, y, z, w = Rotation.from_matrix(rotation.detach().double().cpu().numpy()).as_quat().tolist()
    return torch.tensor([w, x, y, z], dtype=torch.float64)


def quat_product(left: Tensor, right: Tensor) -> Tensor:
    """Quaternions [..., 4], `wxyz`, of the rotations by `right` followed by `left`."""
    left_real, left_vector = left[..., :1], left[..., 1:]
    right_real, right_vector = right[..., :1], right[..., 1:]
    real = left_real * right_real - (left_vector * right_vector).sum(-1, keepdim=True)
    crossed = torch.linalg.cross(left_vector, right_vector)
    return torch.cat([real, left_real * right_vector + right_real * left_vector + crossed], dim=-1)


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """`cam_from_world` [4, 4], float32, of an upright camera at `eye` that looks at `target`, OpenCV axes.

    Args:
        eye: [3] camera centre, world units.
        target: [3] point in the middle of the image.
        up: [3] up direction, of any length.

    Raises:
        ValueError: `eye` and `target` coincide, or the camera looks straight up or down.
    """
    eye, target, up = (vector.detach().to("cpu", torch.float64) for vector in (eye, target, up))
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.linalg.cross(forward, torch.nn.functional.normalize(up, dim=0))
    if not float(right.norm()) > LEAST_SINE:
        raise ValueError(
            f"a camera at {eye.tolist()} cannot look at {target.tolist()} with {up.tolist()} upwards; expected another "
            "place, and a direction that is not that of the view"
        )
    right = torch.nn.functional.normalize(right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose.float()


def nearest_to_lines(centers: Tensor, directions: Tensor) -> Tensor | None:
    """[3] the point nearest to lines from centers [L, 3] along unit vectors [L, 3], float64; None if parallel."""
    across = torch.eye(3, dtype=torch.float64) - directions[:, :, None] * directions[:, None, :]
    normal_matrix = across.sum(0)
    if float(torch.linalg.eigvalsh(normal_matrix)[0]) < LEAST_CROSSING * len(centers):
        return None
    return torch.linalg.solve(normal_matrix, (across @ centers[:, :, None]).sum(0)).squeeze(1)


def mirror_matrices(centers: Tensor, normals: Tensor) -> Tensor:
    """Householder reflections [K, 4, 4] about planes through `centers` with unit `normals`.

    Maps a world point x to x - 2 ((x - c) . n) n (TR-Gaussians, Eq. 8). Its own inverse.
    Differentiable in both arguments.

    Args:
        centers: [K, 3] a point on each plane, world frame.
        normals: [K, 3] unit normals; the sign does not matter.
    """
    outer = normals[:, :, None] * normals[:, None, :]
    linear = torch.eye(3, dtype=normals.dtype, device=normals.device) - 2 * outer
    offset = 2 * (centers * normals).sum(-1, keepdim=True) * normals
    top = torch.cat([linear, offset[:, :, None]], dim=2)
    bottom = constant((0.0, 0.0, 0.0, 1.0), normals.dtype, normals.device)
    return torch.cat([top, bottom.expand(normals.shape[0], 1, 4)], dim=1)


@dataclass(frozen=True, eq=False)
class Camera:
    """One pinhole view of the world.

    Attributes:
        cam_from_world: [4, 4] rigid transform, world to camera. A mirrored camera is left-handed (determinant -1), with
            an orthogonal upper 3x3 block.
        fx, fy, cx, cy: intrinsics in pixels.
        width, height: image size in pixels.
    """

    cam_from_world: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        pose = self.cam_from_world
        if not isinstance(pose, Tensor) or pose.shape != (4, 4):
            given = f"has shape {tuple(pose.shape)}" if isinstance(pose, Tensor) else f"is a {type(pose).__name__}"
            raise ValueError(f"cam_from_world {given}; expected a tensor [4, 4], such as torch.eye(4)")
        lengths = self.fx, self.fy, self.width, self.height
        if not all(0 < length < math.inf for length in lengths) or not math.isfinite(self.cx + self.cy):
            raise ValueError(
                f"a camera of {self.width}x{self.height} pixels with fx={self.fx}, fy={self.fy}, cx={self.cx}, "
                f"cy={self.cy}; expected finite numbers, sizes and focal lengths above 0"
            )
        if self.width != int(self.width) or self.height != int(self.height):
            raise ValueError(f"an image of {self.width}x{self.height} pixels; expected whole numbers")
        for name, kind in (("fx", float), ("fy", float), ("cx", float), ("cy", float), ("width", int), ("height", int)):
            object.__setattr__(self, name, kind(getattr(self, name)))  # A tensor could change later.

    @staticmethod
    def look_at(
        eye: Tensor | Sequence[float],
        target: Tensor | Sequence[float],
        *,
        up: Tensor | Sequence[float],
        fov_rad: float = math.radians(50),
        width: int = 960,
        height: int = 640,
    ) -> Camera:
        """An upright camera at `eye` that looks at `target`, with square pixels and the principal point in the middle.

        Args:
            eye: [3] camera centre, world units.
            target: [3] point in the middle of the image.
            up: [3] up direction; (0, -1, 0) in most captures.
            fov_rad: vertical field of view, radians.
            width: width of the image, pixels.
            height: height of the image, pixels.

        Raises:
            ValueError: `eye` and `target` coincide, the camera looks straight up or down, or the field of view or size
                is invalid.
        """
        if not 0 < fov_rad < math.pi:
            raise ValueError(f"fov_rad is {fov_rad}; expected radians between 0 and pi")
        vectors = [torch.as_tensor(vector, dtype=torch.float64) for vector in (eye, target, up)]
        if shapes := [tuple(vector.shape) for vector in vectors if vector.shape != (3,)]:
            raise ValueError(f"eye, target or up has shape {shapes[0]}; expected three numbers each")
        pose = look_at(*vectors)
        focal = height / 2 / math.tan(fov_rad / 2)
        return Camera(pose, focal, focal, width / 2, height / 2, width, height)

    def __repr__(self) -> str:
        center = ", ".join(f"{value:.4g}" for value in self.center.detach().tolist())
        return f"Camera({self.width}x{self.height}, fx={self.fx:.4g}, fy={self.fy:.4g}, at ({center}))"

    @property
    def intrinsics(self) -> Tensor:
        """[4] tensor (fx, fy, cx, cy)."""
        return self.shared_intrinsics.clone()

    @property
    def shared_intrinsics(self) -> Tensor:
        """The intrinsics as a tensor for kernels, shared between equal cameras; do not modify it."""
        matrix = self.cam_from_world
        return constant((self.fx, self.fy, self.cx, self.cy), matrix.dtype, matrix.device)

    @property
    def center(self) -> Tensor:
        """[3] camera centre in the world."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    def to(self, device: torch.device | torch.dtype | str) -> Camera:
        """The same camera on another device, or in another precision."""
        pose = to_device(self.cam_from_world, device)
        return self if pose is self.cam_from_world else replace(self, cam_from_world=pose)

    def resize(self, width: int, height: int) -> Camera:
        """The same camera with another pixel grid over the same image."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    def scale(self, factor: float) -> Camera:
        """The same camera in other units: its centre moves away from the origin by the factor."""
        pose = self.cam_from_world.clone()
        pose[:3, 3] *= factor
        return replace(self, cam_from_world=pose)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel positions [P, 2] and depths [P] (camera z) of world points [P, 3]."""
        in_camera = points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]
        depth = in_camera[:, 2]
        safe = torch.where(depth.abs() < 1e-12, torch.full_like(depth, 1e-12), depth)
        u = self.fx * in_camera[:, 0] / safe + self.cx
        v = self.fy * in_camera[:, 1] / safe + self.cy
        return torch.stack([u, v], dim=-1), depth


Array = NDArray[np.float64]


def rigid_transform(rotation: Array, center: Array) -> Tensor:
    """`cam_from_world` [4, 4], float32, of a camera at `center` [3] whose axes are the rows of `rotation` [3, 3]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return torch.from_numpy(pose).float()


@dataclass(frozen=True)
class NumpyCamera:
    """A pinhole camera.

    Attributes:
        rotation: [3, 3] of `cam_from_world`.
        center: [3] in the world.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        size: [2] width and height in pixels.
    """

    rotation: Array
    center: Array
    intrinsics: Array
    size: Array

    @staticmethod
    def from_camera(camera: Camera) -> NumpyCamera:
        """The same camera."""
        pose = camera.cam_from_world.detach().cpu().double().numpy()
        return NumpyCamera(
            rotation=pose[:3, :3],
            center=-pose[:3, :3].T @ pose[:3, 3],
            intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float64),
            size=np.array([camera.width, camera.height], dtype=np.float64),
        )

    @property
    def diagonal(self) -> float:
        """Length of the image diagonal, in pixels."""
        return float(np.hypot(*self.size))

    def to_camera_axes(self, points: Array) -> Array:
        """[..., 3] world points in the camera's axes, +z forward."""
        return np.asarray((points - self.center) @ self.rotation.T)

    def pixels(self, in_camera: Array) -> Array:
        """[..., 2] pixels of points [..., 3] in the camera's axes; points behind it are mirrored."""
        fx, fy, cx, cy = self.intrinsics
        depth = np.where(np.abs(in_camera[..., 2]) < 1e-12, 1e-12, in_camera[..., 2])
        return np.stack([fx * in_camera[..., 0] / depth + cx, fy * in_camera[..., 1] / depth + cy], axis=-1)

    def project(self, points: Array) -> Array:
        """[..., 2] pixels of world points [..., 3]."""
        return self.pixels(self.to_camera_axes(points))

    def rays(self, pixels: Array) -> Array:
        """[..., 3] unit world directions through pixels [..., 2], which may be outside the image."""
        fx, fy, cx, cy = self.intrinsics
        x, y = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
        world = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.rotation
        return np.asarray(world / np.linalg.norm(world, axis=-1, keepdims=True))

    def contains(self, points: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """[...] bool: world points inside the image, enlarged by `margin` of its sides."""
        in_camera = self.to_camera_axes(points)
        pixels = self.pixels(in_camera)
        room = margin * self.size
        return np.asarray(
            (in_camera[..., 2] > 0) & (pixels >= -room).all(axis=-1) & (pixels < self.size + room).all(axis=-1)
        )
