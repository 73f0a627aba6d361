"""The best reconstruction of a few attempts, and the capture written from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from glassplat.captures import colmap_library as library
from glassplat.captures.cameras import PixelMap, blank_mask, blank_share, make_lens, undistort
from glassplat.captures.masks import IGNORE_FOLDER
from glassplat.errors import InputError, join_names
from glassplat.files.images import write_image
from glassplat.prepare import colmap
from glassplat.prepare.photographs import Listener, Note, Photograph, read_photograph
from glassplat.training.messages import Working

FEWEST_FEATURES = 50
"""Minimum number of features of at least half of the photographs; fewer cannot be matched."""
ENOUGH_REGISTERED = 0.95
"""Share of registered photographs above which no further attempt of equal cost is made."""


@dataclass(frozen=True)
class Attempt:
    """Settings of one attempt; `name` follows "trying again with"."""

    name: str
    features: colmap.FeatureOptions
    mapping: colmap.MappingOptions


DEFAULT_FEATURES = colmap.FeatureOptions(most=4096, least_contrast=1 / 150)
MANY_FEATURES = colmap.FeatureOptions(most=12_000, least_contrast=1 / 600, guided=True)
ATTEMPTS = (
    Attempt("the usual settings", DEFAULT_FEATURES, colmap.MappingOptions()),
    Attempt("lower thresholds for matches between photographs", DEFAULT_FEATURES, colmap.MappingOptions(8, 20)),
    Attempt("three times as many features, including weak ones", MANY_FEATURES, colmap.MappingOptions()),
    Attempt("many features and lower thresholds", MANY_FEATURES, colmap.MappingOptions(8, 20)),
)


@dataclass(frozen=True)
class Solution:
    """The registered groups of one attempt.

    Attributes:
        database: of the attempt.
        models: `pycolmap.Reconstruction`, the largest first; they are not connected with each other.
        attempt: its name.
        attempts_made: number of attempts.
    """

    database: colmap.FeatureDatabase
    models: Sequence[Any]
    attempt: str
    attempts_made: int

    @property
    def registered(self) -> int:
        """Number of photographs in the largest group."""
        return int(self.models[0].num_reg_images()) if self.models else 0

    def missing(self) -> list[Photograph]:
        """The photographs that are not in the largest group."""
        known = set(image_numbers(self.models[0])) if self.models else set()
        return [one for index, one in enumerate(self.database.photographs) if index not in known]


def image_numbers(model: Any) -> dict[int, Any]:
    """The registered images of a model by the index of their photograph."""
    return {int(Path(image.name).stem): image for image in model.images.values() if image.has_pose}


def best_solution(
    photographs: Sequence[Photograph],
    work: Path,
    listen: Listener,
    *,
    lens: colmap.LensName,
    mapper: colmap.Mapper,
    least: float,
) -> Solution:
    """Registers photographs in several attempts until enough are registered; earlier results in `work` are reused.

    More features take many times as long, so they are tried only if less than the share `least` is registered.
    """
    best: Solution | None = None
    tried = 0
    for attempt in ATTEMPTS:
        if best is not None:
            enough = least if attempt.features == MANY_FEATURES else max(ENOUGH_REGISTERED, least)
            if best.registered >= enough * len(photographs):
                break
            share = f"{best.registered} of {len(photographs)} photographs"
            listen(Note(f"{share} are registered; trying again with {attempt.name}"))
        database = _match_features(photographs, work, attempt.features, lens, listen)
        models = colmap.register_photographs(
            database.path, mapper, attempt.mapping, count=len(photographs), listen=listen
        )
        tried += 1
        found = Solution(database, models, attempt.name, tried)
        if best is None or found.registered > best.registered:
            best = found
    assert best is not None
    return replace(best, attempts_made=tried)


def _match_features(
    photographs: Sequence[Photograph],
    work: Path,
    features: colmap.FeatureOptions,
    lens: colmap.LensName,
    listen: Listener,
) -> colmap.FeatureDatabase:
    """The database of these features, with the pairs selected by `pairs_to_match` matched."""
    database = colmap.FeatureDatabase(work / f"features-{features.most}.db", work / "grey", photographs)
    database.write_images(listen)
    database.create(lens)
    database.extract(features, listen)
    _check_texture(database)
    database.match(colmap.pairs_to_match(database.descriptors()), features, listen)
    return database


class CannotRegisterError(InputError):
    """Raised when no option can register these photographs, so that partial results are useless."""


def _check_texture(database: colmap.FeatureDatabase) -> None:
    counts = database.feature_counts()
    poor = [one.path.name for one, count in zip(database.photographs, counts, strict=True) if count < FEWEST_FEATURES]
    if 2 * len(poor) > len(counts):
        raise CannotRegisterError(
            f"{len(poor)} of {len(counts)} photographs have fewer than {FEWEST_FEATURES} features "
            f"({join_names(poor)}): they are blurred, dark or without texture. Use more light, hold the camera still, "
            "and include textured objects, such as the surroundings of the pane"
        )


JPEG_QUALITY = 95


def write_capture(solution: Solution, folder: Path, listen: Listener) -> None:
    """Writes `images/` and `sparse/0` of the largest group; modifies the solution's model.

    Regions of undistorted photographs outside the view of a wide lens are excluded by masks in `ignore/`.
    """
    model = solution.models[0]
    lenses = {key: library.pycolmap.Camera(camera.todict()) for key, camera in model.cameras.items()}
    checked = {
        key: make_lens(camera.model_name, list(camera.params), (camera.width, camera.height))
        for key, camera in lenses.items()
    }
    wide = {key: lens for key, lens in checked.items() if blank_share(lens)}
    _undistort_model(model)
    images = image_numbers(model)
    for done, (number, image) in enumerate(sorted(images.items())):
        photograph = solution.database.photographs[number]
        listen(Working("undistorting photographs", done, len(images)))
        pixels = undistort(read_photograph(photograph), lenses[image.camera_id])
        target = folder / "images" / photograph.name
        target.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(target, quality=JPEG_QUALITY, subsampling=0)
        if image.camera_id in wide:
            mask = (folder / IGNORE_FOLDER / photograph.name).with_suffix(".png")
            height, width = pixels.shape[:2]
            write_image(mask, 255 * blank_mask(PixelMap(wide[image.camera_id], width, height)))
        image.name = photograph.name
    listen(Working("colouring points from the photographs", 0, len(images)))
    model.extract_colors_for_all_images(folder / "images")
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    model.write_binary(sparse)


def _undistort_model(model: Any) -> None:
    """Replaces the cameras of a model by pinhole cameras, and undistorts its observations."""
    options = library.pycolmap.UndistortCameraOptions()
    pinholes = {key: library.pycolmap.undistort_camera(options, camera) for key, camera in model.cameras.items()}
    for image in image_numbers(model).values():
        pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        rays = np.asarray(model.cameras[image.camera_id].cam_from_img(pixels)).reshape(-1, 2)
        undistorted = pinholes[image.camera_id].img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        for point, pixel in zip(image.points2D, np.asarray(undistorted).reshape(-1, 2), strict=True):
            point.xy = pixel
    for key, pinhole in pinholes.items():
        camera = model.camera(key)
        camera.model, camera.params = pinhole.model, pinhole.params
        camera.width, camera.height = pinhole.width, pinhole.height
