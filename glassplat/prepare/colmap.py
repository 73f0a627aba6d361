"""Interruptible calls of COLMAP: features, pairs to match, and structure from motion.

In the database of an attempt, photographs are named by their index. Its contents persist, so that a repeated call
continues an interrupted one.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.captures import colmap_library as library
from glassplat.errors import InputError
from glassplat.files.records import read_json
from glassplat.files.writing import atomic_write, write_text
from glassplat.options import short_repr
from glassplat.prepare.photographs import Listener, Photograph, read_photograph
from glassplat.training.messages import Working

Result = TypeVar("Result")

POLL_SECONDS = 0.25
"""Seconds between two checks of the progress."""
PAIRS_AT_ONCE = 50
"""Pairs of photographs matched between two checks for cancellation; COLMAP's default of 1225 takes many minutes."""


def run_interruptible(work: Callable[[Any], Result], poll: Callable[[], None] = lambda: None) -> Result:
    """Runs work in a thread, so that signals reach the main thread, which then cancels the work.

    Args:
        work: receives a `pycolmap.CancellationToken`; calls that do not take one run to their end.
        poll: called a few times a second while the work runs.

    Raises:
        Exception: raised by the work.
        KeyboardInterrupt: the command was interrupted; the work has ended.
    """
    token = library.pycolmap.CancellationToken()
    future: Future[Result] = Future()

    def run() -> None:
        try:
            future.set_result(work(token))
        except BaseException as error:  # noqa: BLE001 - Raised again in the calling thread.
            future.set_exception(error)

    threading.Thread(target=run, name="pycolmap", daemon=True).start()
    try:
        while not wait([future], POLL_SECONDS).done:
            poll()
    except BaseException:
        token.cancel()
        wait([future])  # Waits for writes to the database, so that it is consistent.
        raise
    return future.result()


Item = TypeVar("Item")
LensName = Literal["simple_pinhole", "simple_radial", "radial", "opencv", "opencv_fisheye"]
"""COLMAP's camera models, the simplest first: except for the fisheye, each one adds distortion parameters."""

DEFAULT_FOCAL = 1.2
"""Default focal length, in longer image sides, of photographs without EXIF: roughly a phone's main lens."""
SEED = 0
NUMBERING = "photographs.json"
"""File that lists the names of the photographs in the order of their indices."""
DATABASE_ERROR_WORDS = ("SQLite", "database", "basic_string")
"""Parts of COLMAP's messages if its database fails; the last one if a text is missing in it."""


@dataclass(frozen=True)
class FeatureOptions:
    """Options for finding and matching features.

    Attributes:
        most: maximum number of features of one photograph.
        least_contrast: minimum contrast of a feature, COLMAP's peak threshold.
        guided: match a second time along the epipolar lines of the first matches.
    """

    most: int
    least_contrast: float
    guided: bool = False


@dataclass(frozen=True)
class FeatureDatabase:
    """The database of one attempt.

    Attributes:
        path: of the file.
        image_folder: folder of the greyscale images from which features are extracted.
        photographs: in the order of their indices.
    """

    path: Path
    image_folder: Path
    photographs: Sequence[Photograph]

    @property
    def image_names(self) -> list[str]:
        """Names of all photographs in the database."""
        return [f"{index:06d}.png" for index in range(len(self.photographs))]

    def create(self, lens: LensName) -> None:
        """Writes cameras and photographs unless they exist."""
        with self._open() as database:
            if database.num_images() == len(self.photographs):
                return
            database.clear_all_tables()
            keys = dict.fromkeys(map(_camera_key, self.photographs))
            rigs = {key: _add_rig(database, lens, key, self._focal(key)) for key in keys}
            for name, photograph in zip(self.image_names, self.photographs, strict=True):
                camera_id, rig_id = rigs[_camera_key(photograph)]
                image = library.pycolmap.Image(name=name, camera_id=camera_id)
                image.image_id = database.write_image(image)
                frame = library.pycolmap.Frame()
                frame.rig_id = rig_id
                frame.add_data_id(image.data_id)
                database.write_frame(frame)

    def write_images(self, listen: Listener) -> None:
        """Writes missing greyscale images: upright, reduced.

        Raises:
            InputError: the images there, and so the features, are not those of these photographs in this order.
        """
        self.image_folder.mkdir(parents=True, exist_ok=True)
        targets = [self.image_folder / name for name in self.image_names]
        missing = [index for index, target in enumerate(targets) if not target.is_file()]
        record, names = self.image_folder / NUMBERING, [photograph.name for photograph in self.photographs]
        if len(missing) == len(targets):
            write_text(record, json.dumps(names))
        elif not record.is_file() or read_json(record) != names:
            raise InputError(
                f"{self.image_folder.parent} does not hold these photographs in this order: other ones "
                "were selected, or another version of glassplat started it; start again with --force"
            )
        for done, index in enumerate(missing):
            listen(Working("reading the photographs", done, len(missing)))
            with atomic_write(targets[index]) as temporary:
                pixels = read_photograph(self.photographs[index])
                Image.fromarray(pixels).convert("L").save(temporary, compress_level=1)

    def extract(self, features: FeatureOptions, listen: Listener) -> None:
        """Extracts features of the photographs without any."""
        options = library.pycolmap.FeatureExtractionOptions(use_gpu=False)
        options.sift.max_num_features = features.most
        options.sift.peak_threshold = features.least_contrast
        options.sift.first_octave = -1  # Twice the image size, at which the smallest features are found.

        def work(token: Any) -> None:
            library.pycolmap.extract_features(
                self.path,
                self.image_folder,
                image_names=self.image_names,  # A killed command may have left a partial file there.
                extraction_options=options,
                device=library.pycolmap.Device.cpu,
                cancellation_token=token,
            )

        with self._open() as database:
            ids = _image_ids(database)
            _run_with_progress(work, "extracting features", ids, database.exists_keypoints, listen)

    def match(self, pairs: Sequence[tuple[int, int]], features: FeatureOptions, listen: Listener) -> None:
        """Matches pairs of photographs, by index, that are not matched yet."""
        pairs_file = self.path.with_suffix(".pairs.txt")
        names = self.image_names
        pairs_file.write_text("".join(f"{names[one]} {names[other]}\n" for one, other in pairs), encoding="utf-8")
        matching = library.pycolmap.FeatureMatchingOptions(use_gpu=False)
        matching.guided_matching = features.guided
        verification = library.pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = SEED

        def work(token: Any) -> None:
            library.pycolmap.match_image_pairs(
                self.path,
                matching_options=matching,
                pairing_options=library.pycolmap.ImportedPairingOptions(
                    match_list_path=pairs_file, block_size=PAIRS_AT_ONCE
                ),
                verification_options=verification,
                device=library.pycolmap.Device.cpu,
                cancellation_token=token,
            )

        with self._open() as database:
            ids = _image_ids(database)
            items = [(ids[one], ids[other]) for one, other in pairs]
            _run_with_progress(
                work, "matching photographs", items, lambda two: database.exists_two_view_geometry(*two), listen
            )

    def feature_counts(self) -> NDArray[np.int64]:
        """[P] number of features of each photograph."""
        with self._open() as database:
            return np.array([database.num_keypoints_for_image(one) for one in _image_ids(database)], dtype=np.int64)

    def descriptors(self) -> list[NDArray[np.uint8]]:
        """[F, 128] of each photograph, in the order of its features."""
        with self._open() as database:
            return [np.asarray(database.read_descriptors(one).data) for one in _image_ids(database)]

    @contextmanager
    def _open(self) -> Iterator[Any]:
        """Opens the file as COLMAP's database."""
        with check_database(self.path):
            database = library.pycolmap.Database.open(self.path)
            try:
                with closing(database):
                    yield database
            except RuntimeError:
                # After a failed close, as on a full disk, the destructor would abort the process: it must never run.
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(database))
                raise

    def _focal(self, key: tuple[str, int, int]) -> float | None:
        """Median EXIF focal length of the photographs of one camera, in pixels; None if unknown."""
        focals = [one.focal for one in self.photographs if _camera_key(one) == key and one.focal is not None]
        return float(np.median(focals)) if focals else None


@contextmanager
def check_database(path: Path) -> Iterator[None]:
    """Turns COLMAP's errors about its database into InputError, or OSError if the disk is full."""
    try:
        yield
    except (RuntimeError, LookupError, ValueError) as error:
        reason = str(error)
        if isinstance(error, RuntimeError) and not any(word in reason for word in DATABASE_ERROR_WORDS):
            raise
        if "disk is full" in reason:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
        raise InputError(
            f"{path} is damaged, or cannot be written ({short_repr(reason)}); start the preparation again with --force"
        ) from error


def _run_with_progress(
    work: Callable[[Any], Any], what: str, items: Sequence[Item], exists: Callable[[Item], bool], listen: Listener
) -> None:
    """Runs work of COLMAP; its progress is the number of items whose results exist in the database.

    The database is read by COLMAP's SQLite. Python's is another copy in this process: closing a file in one drops the
    locks of the other, which then crashes with a bus error (sqlite.org/howtocorrupt.html, 2.2.1).
    """
    missing = list(items)

    def report() -> None:
        missing[:] = [item for item in missing if not exists(item)]
        listen(Working(what, len(items) - len(missing), len(items)))

    run_interruptible(work, report)


def _image_ids(database: Any) -> list[int]:
    """The database's ids of the photographs, in the order of their indices."""
    return [image.image_id for image in sorted(database.read_all_images(), key=lambda image: str(image.name))]


def _camera_key(photograph: Photograph) -> tuple[str, int, int]:
    return photograph.device, photograph.width, photograph.height


def _add_rig(database: Any, lens: LensName, key: tuple[str, int, int], focal: float | None) -> tuple[int, int]:
    """Adds the camera of a device and a rig with only this camera; returns their ids."""
    _, width, height = key
    model = getattr(library.pycolmap.CameraModelId, lens.upper())
    camera = library.pycolmap.Camera.create_from_model_id(
        0, model, focal or DEFAULT_FOCAL * max(width, height), width, height
    )
    camera.has_prior_focal_length = focal is not None
    camera.camera_id = database.write_camera(camera)
    rig = library.pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    return camera.camera_id, database.write_rig(rig)


Pairs = list[tuple[int, int]]

MOST_EXHAUSTIVE = 80
"""Maximum number of photographs of which all pairs are matched; these are 3160."""
NEIGHBOURS = 10
MOST_SIMILAR = 10
"""Number of similar photographs, taken anywhere, with which each one is matched; this closes loops."""
WORDS, SAMPLED = 64, 20_000
"""Number of visual words, and of descriptors from which they are learned."""


def all_pairs(count: int) -> Pairs:
    """Every pair of photographs."""
    return [(one, other) for one in range(count) for other in range(one)]


def neighbouring_pairs(count: int) -> Pairs:
    """Pairs of each photograph with the next `NEIGHBOURS` in order, and with those 16, 32, ... 512 further on."""
    steps = [*range(1, NEIGHBOURS + 1), *(2**power for power in range(4, 10))]
    return [(index + step, index) for index in range(count) for step in steps if index + step < count]


def similar_pairs(descriptors: Sequence[NDArray[np.uint8]]) -> Pairs:
    """Pairs of each photograph with the `MOST_SIMILAR` nearest ones, by a visual vocabulary learned from all of them.

    The descriptor of a photograph is the sum of differences between its features and their nearest words, for each word
    (VLAD, Jégou et al. 2010), with signed square roots. No pretrained vocabulary is needed.

    Args:
        descriptors: [F, 128] of each photograph.
    """
    signatures = _signatures([np.asarray(part, dtype=np.float32) for part in descriptors])
    similarity = signatures @ signatures.T
    np.fill_diagonal(similarity, -np.inf)
    nearest = np.argsort(-similarity, axis=1, kind="stable")[:, : min(MOST_SIMILAR, len(descriptors) - 1)]
    found = {(max(one, int(other)), min(one, int(other))) for one, row in enumerate(nearest) for other in row}
    return sorted(found)


def pairs_to_match(descriptors: Sequence[NDArray[np.uint8]]) -> Pairs:
    """The pairs to match, of photographs with these descriptors."""
    count = len(descriptors)
    if count <= MOST_EXHAUSTIVE:
        return all_pairs(count)
    return sorted({*neighbouring_pairs(count), *similar_pairs(descriptors)})


def _signatures(descriptors: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """[P, WORDS * 128] unit vectors; zeros where a photograph has no features."""
    from scipy.cluster.vq import kmeans2, vq  # Slow to import, and needed for many photographs only.

    everything = np.concatenate(descriptors)
    rng = np.random.default_rng(SEED)
    sample = everything[rng.permutation(len(everything))[:SAMPLED]]
    words, _ = kmeans2(sample, min(WORDS, len(sample)), minit="points", rng=rng)
    signatures = np.zeros((len(descriptors), *words.shape), words.dtype)
    for sums, features in zip(signatures, descriptors, strict=True):
        if len(features):
            nearest, _ = vq(features, words)
            np.add.at(sums, nearest, features - words[nearest])
        sums[:] = np.sign(sums) * np.sqrt(np.abs(sums))
        sums /= max(float(np.linalg.norm(sums)), 1e-9)
    return signatures.reshape(len(descriptors), -1)


Mapper = Literal["incremental", "global"]


@dataclass(frozen=True)
class MappingOptions:
    """Options for registering photographs.

    Attributes:
        first_angle: minimum triangulation angle of the first two photographs, degrees.
        least_matches: minimum number of inliers among matches to known points for registering a photograph.
    """

    first_angle: float = 16.0
    least_matches: int = 30


REGISTERING = "registering the photographs"


def register_photographs(
    database: Path, mapper: Mapper, options: MappingOptions, *, count: int, listen: Listener
) -> list[Any]:
    """Registers photographs; returns their connected groups as `pycolmap.Reconstruction`, the largest first.

    Args:
        database: file with the matches.
        mapper: incremental or global structure from motion.
        options: thresholds of the incremental mapper.
        count: number of photographs, for the progress.
        listen: receives the progress.
    """
    output = database.with_suffix(".models")
    output.mkdir(exist_ok=True)
    listen(Working(REGISTERING, 0, count))

    def global_mapping(token: Any) -> dict:
        chosen = library.pycolmap.GlobalPipelineOptions(random_seed=SEED)
        return library.pycolmap.global_mapping(database, output, output, options=chosen)

    incremental = _incremental_mapping(database, output, options, count, listen)
    with check_database(database):
        found = run_interruptible(incremental if mapper == "incremental" else global_mapping)
    return sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _incremental_mapping(
    database: Path, output: Path, options: MappingOptions, count: int, listen: Listener
) -> Callable[[Any], dict]:
    chosen = library.pycolmap.IncrementalPipelineOptions(random_seed=SEED, min_model_size=3, extract_colors=False)
    chosen.mapper.init_min_tri_angle = options.first_angle
    chosen.mapper.abs_pose_min_num_inliers = options.least_matches
    group = registered_now = 0

    def report() -> None:
        # Progress is per group, because the remaining time of one is not that of all.
        what = REGISTERING if group <= 1 else f"{REGISTERING}, group {group}"
        listen(Working(what, registered_now, count))

    def begin_group() -> None:
        nonlocal group, registered_now
        group, registered_now = group + 1, 2
        report()

    def count_image() -> None:
        nonlocal registered_now
        registered_now = min(registered_now + 1, count)
        report()

    def work(token: Any) -> dict:
        return library.pycolmap.incremental_mapping(
            database,
            output,
            output,
            options=chosen,
            initial_image_pair_callback=begin_group,
            next_image_callback=count_image,
            cancellation_token=token,
        )

    return work
