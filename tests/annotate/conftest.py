"""A capture of a room with a pane on its wall, whose corners are visible in all views, and its server."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

import numpy as np
import pycolmap
import pytest
from PIL import Image

from glassplat.annotate.server import AnnotationServer
from glassplat.annotate.session import Session, open_session
from glassplat.scene.camera import Camera
from tests.panes.pane_scene import FRONT, camera_from, label_image

PLACES = ((0.0, 0.0, -1.0), (1.2, 0.3, -0.6), (-0.6, -0.6, -0.8), (0.5, 0.5, -1.2), (-1.0, 0.2, -0.9))
NAMES = [f"{number}.png" for number in range(len(PLACES))]
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
WALL, GLASS = (60, 60, 60), (150, 150, 150)


def cameras() -> list[Camera]:
    return [camera_from(place, FRONT.center) for place in PLACES]


def true_corners(number: int) -> np.ndarray:
    """[4, 2] pixels of the pane's corners in a view."""
    corners = FRONT.at(np.array([-1.0, 1, 1, -1]), np.array([-1.0, -1, 1, 1]))
    camera = cameras()[number]
    in_camera = corners @ camera.cam_from_world[:3, :3].numpy().T + camera.cam_from_world[:3, 3].numpy()
    focal, middle = [camera.fx, camera.fy], [camera.cx, camera.cy]
    return in_camera[:, :2] / in_camera[:, 2:] * focal + middle


def write_room(root: Path) -> Path:
    """Five photographs of a grey pane on a dark wall, as transforms.json."""
    (root / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for name, camera in zip(NAMES, cameras(), strict=True):
        pane = label_image(camera, [FRONT]).numpy() == 1
        Image.fromarray(np.where(pane[..., None], GLASS, WALL).astype(np.uint8)).save(root / "images" / name)
        pose = np.linalg.inv(camera.cam_from_world.numpy()) @ OPENGL_FROM_OPENCV
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    lens = {"fl_x": 240.0, "fl_y": 240.0, "cx": 150.0, "cy": 110.0, "w": 300, "h": 220}
    (root / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return root


def write_colmap_room(root: Path, names: Sequence[str]) -> Path:
    """The same as a COLMAP model with other names for the photographs, resolved from `images/`."""
    write_room(root)
    (root / "sparse").mkdir()
    (root / "sparse" / "cameras.txt").write_text("1 PINHOLE 300 220 240 240 150 110\n")
    lines = []
    for number, (old, new, camera) in enumerate(zip(NAMES, names, cameras(), strict=True), start=1):
        (root / "images" / new).parent.mkdir(parents=True, exist_ok=True)
        (root / "images" / old).rename(root / "images" / f"{new}.moved")
        pose = camera.cam_from_world.double().numpy()
        x, y, z, w = pycolmap.Rotation3d(pose[:3, :3]).quat
        lines += [" ".join(map(str, (number, w, x, y, z, *pose[:3, 3], 1, new))), ""]
    for new in names:
        (root / "images" / f"{new}.moved").rename(root / "images" / new)
    (root / "sparse" / "images.txt").write_text("\n".join(lines) + "\n")
    (root / "sparse" / "points3D.txt").write_text("")
    return root


def renamed(document: dict, names: Sequence[str]) -> dict:
    """A document whose photographs are renamed."""
    (pane,) = document["panes"]
    corners = [{names[NAMES.index(name)]: place for name, place in places.items()} for places in pane["corners"]]
    return {**document, "panes": [{**pane, "corners": corners}]}


def marked_document(views: tuple[int, ...] = (0, 1, 2), **more: object) -> dict:
    """A document with all corners marked in some views."""
    corners = [{NAMES[view]: true_corners(view)[corner].tolist() for view in views} for corner in range(4)]
    pane = {"label": 1, "material": "glass", "shape": "rectangle", "corners": corners, "edges": [{}] * 4, "strokes": {}}
    return {"version": 1, "panes": [pane | more]}


def saved(session: Session, document: dict) -> dict:
    """The answer to a page that has received everything saved so far."""
    return session.save({"document": document, "version": session.describe()["version"]})


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return write_room(tmp_path / "räum 1")


@contextmanager
def serving(root: Path) -> Iterator[AnnotationServer]:
    """A server that runs in the background of the test."""
    with AnnotationServer(open_session(root), 0) as server:
        thread = Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
