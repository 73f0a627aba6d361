"""The best reconstruction that a few attempts give, and the capture written from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from glassplat.captures import colmap_library as library
from glassplat.captures.cameras import Lens, PixelMap, blank_share, make_lens, undistort
from glassplat.captures.masks import IGNORE_FOLDER
from glassplat.errors import InputError, first_names
from glassplat.files.images import write_image
from glassplat.prepare.colmap import (
    FeatureDatabase,
    Features,
    LensName,
    Mapper,
    Mapping,
    chosen_pairs,
    register_photographs,
)
from glassplat.prepare.photographs import Listener, Note, Photograph, read_photograph
from glassplat.training.messages import Working

FEWEST_FEATURES = 50
"""Of the middle photograph; with fewer nothing can be matched."""
ENOUGH = 0.95
"""Share of the photographs with which no further attempt is made that takes no longer."""


@dataclass(frozen=True)
class Attempt:
    """Settings of one attempt; `name` ends "trying again with"."""

    name: str
    features: Features
    mapping: Mapping


USUAL = Features(most=4096, least_contrast=1 / 150)
MANY = Features(most=12_000, least_contrast=1 / 600, guided=True)
ATTEMPTS = (
    Attempt("the usual settings", USUAL, Mapping()),
    Attempt("lower thresholds for matches between photographs", USUAL, Mapping(8, 20)),
    Attempt("three times as many features, including weak ones", MANY, Mapping()),
    Attempt("many features and lower thresholds", MANY, Mapping(8, 20)),
)


@dataclass(frozen=True)
class Solution:
    """The groups that one attempt registered.

    Attributes:
        database: of the attempt.
        models: `pycolmap.Reconstruction`, the largest first; photographs in different ones share nothing.
        attempt: its name.
        tried: how many attempts were made.
    """

    database: FeatureDatabase
    models: Sequence[Any]
    attempt: str
    tried: int

    @property
    def registered(self) -> int:
        """Photographs in the largest group."""
        return int(self.models[0].num_reg_images()) if self.models else 0

    def missing(self) -> list[Photograph]:
        """The photographs that are not in the largest group."""
        known = set(image_numbers(self.models[0])) if self.models else set()
        return [one for index, one in enumerate(self.database.photographs) if index not in known]


@dataclass(frozen=True)
class Settings:
    """Options for registering photographs.

    Attributes:
        lens: COLMAP's camera model.
        mapper: one photograph after the other, or all at once.
    """

    lens: LensName = "simple_radial"
    mapper: Mapper = "incremental"


def image_numbers(model: Any) -> dict[int, Any]:
    """The registered images of a model by the number of their photograph."""
    return {int(Path(image.name).stem): image for image in model.images.values() if image.has_pose}


def best_solution(
    photographs: Sequence[Photograph], work: Path, settings: Settings, least: float, listen: Listener
) -> Solution:
    """Places photographs, with as many attempts as it takes; what lies in `work` from before is used.

    More features take many times as long, so they are tried only where less than the share `least` was registered.
    """
    best: Solution | None = None
    tried = 0
    for attempt in ATTEMPTS:
        if best is not None:
            enough = least if attempt.features == MANY else max(ENOUGH, least)
            if best.registered >= enough * len(photographs):
                break
            note = (
                f"{best.registered} of {len(photographs)} photographs are registered; trying again with {attempt.name}"
            )
            listen(Note(note))
        database = _match_features(photographs, work, attempt.features, settings, listen)
        models = register_photographs(
            database.path, settings.mapper, attempt.mapping, count=len(photographs), listen=listen
        )
        tried += 1
        found = Solution(database, models, attempt.name, tried)
        if best is None or found.registered > best.registered:
            best = found
    assert best is not None
    return replace(best, tried=tried)


def _match_features(
    photographs: Sequence[Photograph], work: Path, features: Features, settings: Settings, listen: Listener
) -> FeatureDatabase:
    """The database of these features, with every pair matched that is worth it."""
    database = FeatureDatabase(work / f"features-{features.most}.db", work / "grey", photographs)
    database.write_pictures(listen)
    database.create(settings.lens)
    database.extract(features, listen)
    _check_texture(database)
    database.match(chosen_pairs(database.descriptors()), features, listen)
    return database


class TooLittleShownError(InputError):
    """No option gives these photographs poses, so nothing that was done so far is of use."""


def _check_texture(database: FeatureDatabase) -> None:
    counts = database.feature_counts()
    poor = [one.path.name for one, count in zip(database.photographs, counts, strict=True) if count < FEWEST_FEATURES]
    if 2 * len(poor) > len(counts):
        raise TooLittleShownError(
            f"{len(poor)} of {len(counts)} photographs have fewer than {FEWEST_FEATURES} features "
            f"({first_names(poor)}): they are blurred, dark or without texture. Use more light, hold the camera still, "
            "and include textured objects, such as the surroundings of the pane"
        )


JPEG_QUALITY = 95


def write_capture(solution: Solution, folder: Path, listen: Listener) -> None:
    """Writes `images/` and `sparse/0` of the largest group; the solution's model is changed on the way.

    What a wide lens did not see of its undistorted photographs is left out by masks in `ignore/`.
    """
    model = solution.models[0]
    lenses = {key: library.pycolmap.Camera(camera.todict()) for key, camera in model.cameras.items()}
    wide = _wide_lenses(lenses)
    _straighten(model)
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
            write_image(mask, 255 * PixelMap(wide[image.camera_id], width, height).blank())
        image.name = photograph.name
    listen(Working("colouring points from the photographs", 0, len(images)))
    model.extract_colors_for_all_images(folder / "images")
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    model.write_binary(sparse)


def _wide_lenses(cameras: dict[int, Any]) -> dict[int, Lens]:
    """The lenses that did not see all of their undistorted photographs."""
    lenses = {
        key: make_lens(camera.model_name, list(camera.params), (camera.width, camera.height))
        for key, camera in cameras.items()
    }
    return {key: lens for key, lens in lenses.items() if blank_share(lens)}


def _straighten(model: Any) -> None:
    """Gives a model pinhole cameras, and its observations the places that these show them at."""
    options = library.pycolmap.UndistortCameraOptions()
    pinholes = {key: library.pycolmap.undistort_camera(options, camera) for key, camera in model.cameras.items()}
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
