"""Panes in the world, cameras that look at them, and the resulting masks and points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from glassplat.panes.masks import FramedPlanes
from glassplat.render.deferred import view_directions
from glassplat.scene.camera import Camera
from glassplat.scene.panes import Planes

Annotations = list[tuple[Camera, torch.Tensor]]


@dataclass(frozen=True)
class Pane:
    """A rectangle in the world."""

    center: np.ndarray
    normal: np.ndarray
    tangent: np.ndarray
    half_sizes: tuple[float, float]

    @property
    def plane(self) -> FramedPlanes:
        """Its plane, without a frame."""
        return FramedPlanes(self.normal[None], np.array([self.normal @ self.center]), np.zeros(1))

    @property
    def bitangent(self) -> np.ndarray:
        return np.cross(self.normal, self.tangent)

    def at(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """World points at coordinates in [-1, 1]."""
        half_u, half_v = self.half_sizes
        return self.center + np.outer(u * half_u, self.tangent) + np.outer(v * half_v, self.bitangent)

    def larger(self, factor: float) -> "Pane":
        """The pane with longer sides."""
        return replace(self, half_sizes=(factor * self.half_sizes[0], factor * self.half_sizes[1]))


FRONT = Pane(np.array([0.2, -0.1, 2.0]), np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), (0.8, 0.5))
SIDE = Pane(np.array([-1.5, 0.0, 1.5]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), (0.6, 0.4))
EYES = ((0.0, 0.0, -1.0), (1.2, 0.3, -0.6), (-0.4, -0.6, -0.8))


def camera_from(eye: Sequence[float], target: np.ndarray) -> Camera:
    eye = np.asarray(eye)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return Camera(torch.tensor(matrix), 240.0, 240.0, 150.0, 110.0, 300, 220)


def label_image(camera: Camera, panes: Sequence[Pane]) -> torch.Tensor:
    """[H, W] number of the nearest pane along each pixel's ray, counted from 1; 0 where there is none."""
    rays, eye = view_directions(camera).numpy(), camera.center.numpy()
    labels, nearest = np.zeros(rays.shape[:2], dtype=np.uint8), np.full(rays.shape[:2], np.inf)
    for number, pane in enumerate(panes, start=1):
        slope = rays @ pane.normal
        depth = ((pane.center - eye) @ pane.normal) / np.where(slope == 0, 1e-12, slope)
        away = eye + depth[..., None] * rays - pane.center
        inside = (np.abs(away @ pane.tangent) <= pane.half_sizes[0]) & (
            np.abs(away @ pane.bitangent) <= pane.half_sizes[1]
        )
        found = inside & (depth > 0) & (depth < nearest)
        labels[found], nearest[found] = number, depth[found]
    return torch.from_numpy(labels)


def scene_of(panes: Sequence[Pane], eyes: Sequence[Sequence[float]] = EYES) -> Annotations:
    target = np.mean([pane.center for pane in panes], axis=0)
    cameras = [camera_from(eye, target) for eye in eyes]
    return [(camera, label_image(camera, panes)) for camera in cameras]


def frame_bars(pane: Pane, height: float, width: float = 0.06) -> list[Pane]:
    """The faces of a frame around a pane: its upper side, and its inner walls, which stand on the pane's outline."""
    faces = []
    outlines = zip((pane.tangent, pane.bitangent), (pane.bitangent, pane.tangent), pane.half_sizes, strict=True)
    for (across, along, half), length in zip(outlines, pane.half_sizes[::-1], strict=True):
        for sign in (-1.0, 1.0):
            edge = pane.center + sign * half * across
            wall = (edge + height / 2 * pane.normal, -sign * across, along, (length, height / 2))
            middle = edge + height * pane.normal + sign * width / 2 * across
            faces += [Pane(*wall), Pane(middle, pane.normal, along, (length + width, width / 2))]
    return faces


def framed_scene_of(pane: Pane, height: float, eyes: Sequence[Sequence[float]]) -> Annotations:
    """Masks of a pane in a frame that protrudes along its normal."""
    annotations = scene_of([pane, *frame_bars(pane, height)], eyes)
    return [(camera, torch.where(labels == 1, 1, 0)) for camera, labels in annotations]


def frame_and_clutter(panes: Sequence[Pane], *, noise: float = 0.01, frame: int = 80, wall: int = 2000) -> torch.Tensor:
    """Noisy points on the frames, and many more on a wall behind and in free space."""
    rng = np.random.default_rng(0)
    points = []
    for pane in panes:
        along, side = rng.uniform(-1.05, 1.05, frame), rng.choice([-1.03, 1.03], frame)
        upright = rng.random(frame) < 0.5
        points.append(pane.at(np.where(upright, side, along), np.where(upright, along, side)))
    points.append(rng.uniform([-3, -2, 3.5], [3, 2, 3.5], (wall, 3)))
    points.append(rng.uniform([-3, -2, -1], [3, 2, 3.5], (300, 3)))
    positions = np.concatenate(points)
    return torch.tensor(positions + noise * rng.standard_normal(positions.shape))


def ragged(labels: torch.Tensor, *, amplitude: float, seed: int) -> torch.Tensor:
    """A mask with an edge displaced by some pixels, with holes in it and specks around it."""
    rng = np.random.default_rng(seed)
    mask = labels.numpy() == 1
    waves = ndimage.gaussian_filter(rng.standard_normal(mask.shape), 2)
    distance = ndimage.distance_transform_edt(mask) - ndimage.distance_transform_edt(~mask)
    mask = distance + amplitude * waves / waves.std() > 0
    blots = ndimage.gaussian_filter(rng.standard_normal(mask.shape), 3)
    return torch.from_numpy(mask ^ (np.abs(blots) > 3 * blots.std())).to(torch.uint8)


def normal_error(planes: Planes, index: int, pane: Pane) -> float:
    """Angle in degrees between signed normals."""
    cosine = float(planes.normals[index].double() @ torch.tensor(pane.normal))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def offset_error(planes: Planes, index: int, pane: Pane) -> float:
    away = torch.tensor(pane.center) - planes.centers[index].double()
    return abs(float(away @ planes.normals[index].double()))


def covers(planes: Planes, index: int, pane: Pane) -> bool:
    corners = torch.tensor(pane.at(np.array([-1, -1, 1, 1]), np.array([-1, 1, -1, 1]))) - planes.centers[index]
    along = [float((corners @ axis[index].double()).abs().max()) for axis in planes.axes()]
    return all(reach <= half for reach, half in zip(along, planes.half_sizes[index].tolist(), strict=True))
