"""A solution as a capture: photographs without distortion, and the COLMAP model that belongs to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.data.colmap_library import pycolmap
from glassplat.data.lens import undistorted
from glassplat.prepare.messages import Listener, Progress
from glassplat.prepare.photographs import read_photograph
from glassplat.prepare.reconstruction import Solution, image_numbers

JPEG_QUALITY = 95


def write_capture(solution: Solution, folder: Path, listen: Listener) -> None:
    """Writes `images/` and `sparse/0` of the largest group; the solution's model is changed on the way.

    Raises:
        InputError: a photograph can no longer be read.
    """
    model = solution.models[0]
    lenses = {key: pycolmap.Camera(camera.todict()) for key, camera in model.cameras.items()}
    _straighten(model)
    colors = PointColors(model)
    images = image_numbers(model)
    for done, (number, image) in enumerate(sorted(images.items())):
        photograph = solution.database.photographs[number]
        listen(Progress("writing photographs without distortion", done, len(images)))
        pixels = undistorted(read_photograph(photograph), lenses[image.camera_id])
        colors.look(image, pixels)
        target = folder / "images" / photograph.name
        target.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(target, quality=JPEG_QUALITY, subsampling=0)
        image.name = photograph.name
    colors.apply()
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    model.write_binary(sparse)


def _straighten(model: Any) -> None:
    """Gives a model pinhole cameras, and its observations the places that these show them at."""
    options = pycolmap.UndistortCameraOptions()
    pinholes = {key: pycolmap.undistort_camera(options, camera) for key, camera in model.cameras.items()}
    for image in image_numbers(model).values():
        pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        rays = np.asarray(model.cameras[image.camera_id].cam_from_img(pixels)).reshape(-1, 2)
        straight = pinholes[image.camera_id].img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        for point, place in zip(image.points2D, np.asarray(straight).reshape(-1, 2), strict=True):
            point.xy = place
    for key, pinhole in pinholes.items():
        camera = model.camera(key)
        camera.model, camera.params = pinhole.model, pinhole.params
        camera.width, camera.height = pinhole.width, pinhole.height


class PointColors:
    """Colours of a model's points: the mean of what photographs show at their places."""

    def __init__(self, model: Any) -> None:
        self._points = model.points3D
        self._rows = {key: row for row, key in enumerate(self._points)}
        self._sums = np.zeros((len(self._rows), 3))
        self._counts = np.zeros(len(self._rows))

    def look(self, image: Any, pixels: NDArray[np.uint8]) -> None:
        """Adds what one photograph [H, W, 3] shows."""
        seen = [(point.point3D_id, point.xy) for point in image.points2D if point.has_point3D()]
        if not seen:
            return
        rows = np.array([self._rows[key] for key, _ in seen])
        places = np.floor(np.array([place for _, place in seen])).astype(np.int64)
        height, width = pixels.shape[:2]
        inside = (places >= 0).all(axis=1) & (places < [width, height]).all(axis=1)
        column, row = places[inside].T
        np.add.at(self._sums, rows[inside], pixels[row, column])
        np.add.at(self._counts, rows[inside], 1)

    def apply(self) -> None:
        """Writes the colours into the model; grey where no photograph showed the point."""
        means = np.where(
            self._counts[:, None] > 0, self._sums / np.maximum(self._counts, 1)[:, None], np.full((1, 3), 128)
        )
        for key, row in self._rows.items():
            self._points[key].color = np.round(means[row]).astype(np.uint8)
