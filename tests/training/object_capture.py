"""A tiny capture of an object without background: transparent photographs in the layout of Shiny Blender, on disk."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from glassplat.files.ply_table import write_table

SIZE = 40
RADIUS = 0.8
DISTANCE = 4.0
POINTS = 300
OPENING_ANGLE_RAD = 0.7
COLOR = (200, 40, 40)


def world_from_opengl(angle_rad: float) -> np.ndarray:
    """[4, 4] a camera on a ring about the origin that looks at it; world up is +z."""
    backward = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(up, backward), up, backward], axis=1)
    pose[:3, 3] = DISTANCE * backward
    return pose


def seen_normals(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World normals [H, W, 3] of a ball about the origin, and the mask [H, W] of its visible pixels."""
    focal = 0.5 * SIZE / math.tan(0.5 * OPENING_ANGLE_RAD)
    steps = (np.arange(SIZE) + 0.5 - SIZE / 2) / focal
    x, y = np.meshgrid(steps, -steps)
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = -(rays @ pose[:3, 3])
    inside = RADIUS**2 - (DISTANCE**2 - along**2)
    hits = pose[:3, 3] + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    return hits / np.linalg.norm(hits, axis=-1, keepdims=True), inside > 0


def write_part(root: Path, part: str, angles_rad: np.ndarray) -> None:
    """Photographs, true normals and true strength of one part, and its transforms file."""
    (root / part).mkdir(parents=True)
    frames = []
    for index, angle_rad in enumerate(angles_rad):
        pose = world_from_opengl(angle_rad)
        normals, seen = seen_normals(pose)
        alpha = (255 * seen).astype(np.uint8)[..., None]
        # Colours of transparent pixels must not matter.
        photo = np.concatenate([np.where(seen[..., None], COLOR, (0, 255, 0)).astype(np.uint8), alpha], axis=-1)
        Image.fromarray(photo).save(root / part / f"r_{index}.png")
        encoded = np.round(255 * (normals + 1) / 2).astype(np.uint8)
        Image.fromarray(np.concatenate([encoded * seen[..., None], alpha], axis=-1)).save(
            root / part / f"r_{index}_normal.png"
        )
        strength = np.where(seen & (normals[..., 2] > 0), 52428, 0).astype(np.uint16)
        Image.fromarray(strength).save(root / part / f"r_{index}_strength.png")
        frames.append({"file_path": f"./{part}/r_{index}", "transform_matrix": pose.tolist()})
    settings = {"camera_angle_x": OPENING_ANGLE_RAD, "frames": frames}
    (root / f"transforms_{part}.json").write_text(json.dumps(settings))


def write_object_capture(root: Path) -> Path:
    """Four training and two test views of a red ball with a shiny upper half; returns the folder."""
    write_part(root, "train", np.linspace(0, 2 * math.pi, 4, endpoint=False))
    write_part(root, "test", np.array([0.4, 2.0]))
    directions = np.random.default_rng(0).normal(size=(POINTS, 3))
    positions = 0.9 * RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rows = np.concatenate([positions, np.tile(COLOR, (POINTS, 1))], axis=1).astype(np.float32)
    write_table(root / "points3d.ply", ["x", "y", "z", "red", "green", "blue"], rows)
    return root


def few_steps(capture: Path, output: Path) -> list[str]:
    """Options for a run of a few small steps of `deferred` or `traced`."""
    run = ["--data", str(capture), "--output", str(output), "--iterations", "12", "--least-iterations", "1"]
    return [*run, "--sh-degree", "1", "--texels", "8", "--first-texels", "4"]
