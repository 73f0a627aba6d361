"""COLMAP's features, pairs and structure from motion, called so that they can be interrupted.

In the database of an attempt photographs go by numbers, whatever they are called. What is in it stays: a call that was
interrupted goes on.
"""

from __future__ import annotations

import ctypes
import errno
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.captures import colmap_library as library
from glassplat.errors import InputError
from glassplat.files.writing import atomic_write
from glassplat.options import short_repr
from glassplat.prepare.photographs import Listener, Photograph, read_photograph
from glassplat.training.messages import Working

Result = TypeVar("Result")

LOOK_EVERY = 0.25
"""Seconds between two looks at how far a call is."""
PAIRS_AT_ONCE = 50
"""Pairs of photographs matched between two looks at whether to end early; COLMAP's own 1225 are many minutes' work."""


def interruptible(work: Callable[[Any], Result], meanwhile: Callable[[], None] = lambda: None) -> Result:
    """Runs work in a thread, so that signals reach the main thread, which has the work end early.

    Args:
        work: is given the `pycolmap.CancellationToken` to hand on; what knows none runs to its end.
        meanwhile: called a few times a second while the work goes on.

    Raises:
        Exception: what the work raised.
        KeyboardInterrupt: somebody asked for the end, and the work has ended.
    """
    token = library.pycolmap.CancellationToken()
    results: list[Result] = []
    errors: list[BaseException] = []
    # Not `join`: one that a signal interrupts takes the thread for ended, and the next one returns at once.
    ended = threading.Event()

    def run() -> None:
        try:
            results.append(work(token))
        except BaseException as error:  # noqa: BLE001 - Raised again where somebody waits.
            errors.append(error)
        finally:
            ended.set()

    threading.Thread(target=run, name="pycolmap", daemon=True).start()
    try:
        while not ended.wait(LOOK_EVERY):
            meanwhile()
    except BaseException:
        token.cancel()
        ended.wait()  # It writes into the database: whoever goes on from here finds it whole.
        raise
    if errors:
        raise errors[0]
    return results[0]


Item = TypeVar("Item")
LensName = Literal["simple_pinhole", "simple_radial", "radial", "opencv", "opencv_fisheye"]
"""COLMAP's camera models, the simplest first: two fish-eyes aside, each next one bends lines in more ways."""

USUAL_FOCAL = 1.2
"""Focal length in longer image sides, where a photograph does not tell: roughly a telephone's main lens."""
SEED = 0
OF_DATABASE = ("SQLite", "database", "basic_string")
"""In what COLMAP says where its database fails; the last where a text is missing in it."""


@dataclass(frozen=True)
class Features:
    """Options for finding and matching features.

    Attributes:
        most: features of one photograph.
        least_contrast: of a feature, as COLMAP's peak threshold.
        guided: match a second time along the lines that the first matches lead to.
    """

    most: int
    least_contrast: float
    guided: bool = False


@dataclass(frozen=True)
class FeatureDatabase:
    """The database of one attempt.

    Attributes:
        path: of the file.
        pictures: folder of the grey pictures that features are found in.
        photographs: in the order of their numbers.
    """

    path: Path
    pictures: Path
    photographs: Sequence[Photograph]

    @property
    def picture_names(self) -> list[str]:
        """Names of all photographs in the database."""
        return [self.picture_name(index) for index in range(len(self.photographs))]

    def picture_name(self, index: int) -> str:
        """Name of a photograph in the database."""
        return f"{index:06d}.png"

    def create(self, lens: LensName) -> None:
        """Writes cameras and photographs, if they are not there yet."""
        with self._open() as database:
            if database.num_images() == len(self.photographs):
                return
            database.clear_all_tables()
            keys = dict.fromkeys(map(_camera_key, self.photographs))
            rigs = {key: _new_rig(database, lens, key, self._focal(key)) for key in keys}
            for index, photograph in enumerate(self.photographs):
                _add_image(database, self.picture_name(index), *rigs[_camera_key(photograph)])

    def write_pictures(self, listen: Listener) -> None:
        """Writes the grey pictures that are missing: upright, reduced."""
        self.pictures.mkdir(parents=True, exist_ok=True)
        targets = [self.pictures / name for name in self.picture_names]
        missing = [index for index, target in enumerate(targets) if not target.is_file()]
        for done, index in enumerate(missing):
            listen(Working("reading the photographs", done, len(missing)))
            with atomic_write(targets[index]) as temporary:
                pixels = read_photograph(self.photographs[index])
                Image.fromarray(pixels).convert("L").save(temporary, compress_level=1)

    def extract(self, features: Features, listen: Listener) -> None:
        """Finds the features of the photographs that have none yet."""
        options = library.pycolmap.FeatureExtractionOptions(use_gpu=False)
        options.sift.max_num_features = features.most
        options.sift.peak_threshold = features.least_contrast
        options.sift.first_octave = -1  # Twice the size, in which the smallest are found.

        def work(token: Any) -> None:
            library.pycolmap.extract_features(
                self.path,
                self.pictures,
                image_names=self.picture_names,  # A command that was killed may have left half a picture there.
                extraction_options=options,
                device=library.pycolmap.Device.cpu,
                cancellation_token=token,
            )

        with self._open() as database:
            watched = _Watched("looking for features", _image_ids(database), database.exists_keypoints, listen)
            interruptible(work, watched.look)

    def match(self, pairs: Sequence[tuple[int, int]], features: Features, listen: Listener) -> None:
        """Matches pairs of photographs, by number, that are not matched yet."""
        listed = self.path.with_suffix(".pairs.txt")
        names = [(self.picture_name(one), self.picture_name(other)) for one, other in pairs]
        listed.write_text("".join(f"{one} {other}\n" for one, other in names), encoding="utf-8")
        matching = library.pycolmap.FeatureMatchingOptions(use_gpu=False)
        matching.guided_matching = features.guided
        verification = library.pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = SEED

        def work(token: Any) -> None:
            library.pycolmap.match_image_pairs(
                self.path,
                matching_options=matching,
                pairing_options=library.pycolmap.ImportedPairingOptions(
                    match_list_path=listed, block_size=PAIRS_AT_ONCE
                ),
                verification_options=verification,
                device=library.pycolmap.Device.cpu,
                cancellation_token=token,
            )

        with self._open() as database:
            ids = _image_ids(database)
            items = [(ids[one], ids[other]) for one, other in pairs]
            watched = _Watched(
                "matching photographs", items, lambda two: database.exists_two_view_geometry(*two), listen
            )
            interruptible(work, watched.look)

    def feature_counts(self) -> NDArray[np.int64]:
        """[P] features of each photograph."""
        with self._open() as database:
            return np.array([database.num_keypoints_for_image(one) for one in _image_ids(database)], dtype=np.int64)

    def descriptors(self) -> list[NDArray[np.uint8]]:
        """[F, 128] of each photograph, the order of the features as found."""
        with self._open() as database:
            return [np.asarray(database.read_descriptors(one).data) for one in _image_ids(database)]

    @contextmanager
    def _open(self) -> Iterator[Any]:
        """The file as COLMAP's database."""
        with check_database(self.path):
            database = library.pycolmap.Database.open(self.path)
            try:
                with closing(database):
                    yield database
            except RuntimeError:
                # Where closing failed, as on a full disk, so does the destructor, and ends the process: it never runs.
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(database))
                raise

    def _focal(self, key: tuple[str, int, int]) -> float | None:
        """Median focal length in the photographs of one camera; None if none has one."""
        focals = [one.focal for one in self.photographs if _camera_key(one) == key and one.focal is not None]
        return float(np.median(focals)) if focals else None


@contextmanager
def check_database(path: Path) -> Iterator[None]:
    """Says in words what is wrong with a database that COLMAP cannot work with."""
    try:
        yield
    except InputError:
        raise
    except (RuntimeError, LookupError, ValueError) as error:
        reason = str(error)
        if isinstance(error, RuntimeError) and not any(word in reason for word in OF_DATABASE):
            raise
        if "disk is full" in reason:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
        raise InputError(
            f"{path} is damaged, or cannot be written ({short_repr(reason)}); start the preparation again with --force"
        ) from error


class _Watched(Generic[Item]):
    """Tells of how many items a database has what COLMAP finds, while COLMAP is at it.

    It is read by COLMAP's SQLite. Python's is another copy in this process: closing a file in one drops the locks of
    the other, which then dies of a bus error (sqlite.org/howtocorrupt.html, 2.2.1).
    """

    def __init__(self, what: str, items: Sequence[Item], exists: Callable[[Item], bool], listen: Listener) -> None:
        self._what, self._total = what, len(items)
        self._missing, self._exists, self._listen = items, exists, listen

    def look(self) -> None:
        """Looks for what was missing the last time, and tells."""
        self._missing = [item for item in self._missing if not self._exists(item)]
        self._listen(Working(self._what, self._total - len(self._missing), self._total))


def _image_ids(database: Any) -> list[int]:
    """The database's ids of the photographs, in their order."""
    return [image.image_id for image in sorted(database.read_all_images(), key=lambda image: str(image.name))]


def _camera_key(photograph: Photograph) -> tuple[str, int, int]:
    return photograph.device, photograph.width, photograph.height


def _new_rig(database: Any, lens: LensName, key: tuple[str, int, int], focal: float | None) -> tuple[int, int]:
    """Adds the camera of a device, alone on its rig; the ids of both."""
    _, width, height = key
    model = getattr(library.pycolmap.CameraModelId, lens.upper())
    camera = library.pycolmap.Camera.create_from_model_id(
        0, model, focal or USUAL_FOCAL * max(width, height), width, height
    )
    camera.has_prior_focal_length = focal is not None
    camera.camera_id = database.write_camera(camera)
    rig = library.pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    return camera.camera_id, database.write_rig(rig)


def _add_image(database: Any, name: str, camera_id: int, rig_id: int) -> None:
    image = library.pycolmap.Image(name=name, camera_id=camera_id)
    image.image_id = database.write_image(image)
    frame = library.pycolmap.Frame()
    frame.rig_id = rig_id
    frame.add_data_id(image.data_id)
    database.write_frame(frame)


Pairs = list[tuple[int, int]]

MOST_EXHAUSTIVE = 80
"""Photographs of which all pairs are compared; they are 3160."""
NEIGHBOURS = 10
ALIKE = 10
"""Of each photograph: those that it is compared with wherever they were taken, which closes loops."""
WORDS, SAMPLED = 64, 20_000
"""Of the visual vocabulary, and descriptors that it is learned from."""


def all_pairs(count: int) -> Pairs:
    """Every pair of photographs."""
    return [(one, other) for one in range(count) for other in range(one)]


def neighbouring_pairs(count: int) -> Pairs:
    """The next `NEIGHBOURS` of each photograph in the order they were taken in, and those 16, 32, ... farther."""
    steps = [*range(1, NEIGHBOURS + 1), *(2**power for power in range(4, 10))]
    return [(index + step, index) for index in range(count) for step in steps if index + step < count]


def alike_pairs(descriptors: Sequence[NDArray[np.uint8]]) -> Pairs:
    """The `ALIKE` photographs that look most like each one, by the words of a vocabulary learned from all of them.

    A photograph is described by how its features differ from their nearest words, summed for each word (VLAD, Jégou et
    al. 2010), with signed square roots. No vocabulary learned elsewhere is needed.

    Args:
        descriptors: [F, 128] of each photograph.
    """
    signatures = _signatures([np.asarray(part, dtype=np.float32) for part in descriptors])
    likeness = signatures @ signatures.T
    np.fill_diagonal(likeness, -np.inf)
    nearest = np.argsort(-likeness, axis=1, kind="stable")[:, : min(ALIKE, len(descriptors) - 1)]
    found = {(max(one, int(other)), min(one, int(other))) for one, row in enumerate(nearest) for other in row}
    return sorted(found)


def chosen_pairs(descriptors: Sequence[NDArray[np.uint8]]) -> Pairs:
    """The pairs to compare of photographs with these descriptors."""
    count = len(descriptors)
    if count <= MOST_EXHAUSTIVE:
        return all_pairs(count)
    return sorted({*neighbouring_pairs(count), *alike_pairs(descriptors)})


def _signatures(descriptors: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """[P, WORDS * 128] unit vectors; zeros where a photograph has no features."""
    from scipy.cluster.vq import kmeans2  # Slow to import, and only many photographs need it.

    everything = np.concatenate(descriptors)
    rng = np.random.default_rng(SEED)
    sample = everything[rng.permutation(len(everything))[:SAMPLED]]
    words, _ = kmeans2(sample, min(WORDS, len(sample)), minit="points", rng=rng)
    return np.stack([_signature(part, words) for part in descriptors])


def _signature(features: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    from scipy.cluster.vq import vq

    sums = np.zeros_like(words)
    if len(features):
        nearest, _ = vq(features, words)
        np.add.at(sums, nearest, features - words[nearest])
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    return (sums / max(float(np.linalg.norm(sums)), 1e-9)).ravel()


Mapper = Literal["incremental", "global"]


@dataclass(frozen=True)
class Mapping:
    """Options for registering photographs.

    Attributes:
        first_angle: degrees between the sight lines of the first two photographs.
        least_matches: on known points, with which a photograph is registered.
    """

    first_angle: float = 16.0
    least_matches: int = 30


REGISTERING = "registering the photographs"


def register_photographs(
    database: Path, mapper: Mapper, options: Mapping, *, count: int, listen: Listener
) -> list[Any]:
    """The connected groups of photographs that were registered, each a `pycolmap.Reconstruction`, the largest first.

    Args:
        database: the matches.
        mapper: one photograph after the other, or all at once.
        options: how.
        count: of the photographs, for the progress.
        listen: is told how far it is.
    """
    output = database.with_suffix(".models")
    output.mkdir(exist_ok=True)
    listen(Working(REGISTERING, 0, count))
    if mapper == "incremental":
        work = _incremental(database, output, _incremental_options(options), count, listen)
    else:
        work = _global(database, output)
    with check_database(database):
        found = interruptible(work)
    return sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _incremental(database: Path, output: Path, options: Any, count: int, listen: Listener) -> Callable[[Any], dict]:
    group = registered_now = 0

    def tell() -> None:
        # Each group is work of its own: its time left is not that of the whole.
        what = REGISTERING if group <= 1 else f"{REGISTERING}, group {group}"
        listen(Working(what, registered_now, count))

    def begun() -> None:
        nonlocal group, registered_now
        group, registered_now = group + 1, 2
        tell()

    def next_one() -> None:
        nonlocal registered_now
        registered_now = min(registered_now + 1, count)
        tell()

    def work(token: Any) -> dict:
        return library.pycolmap.incremental_mapping(
            database,
            output,
            output,
            options=options,
            initial_image_pair_callback=begun,
            next_image_callback=next_one,
            cancellation_token=token,
        )

    return work


def _global(database: Path, output: Path) -> Callable[[Any], dict]:
    options = library.pycolmap.GlobalPipelineOptions(random_seed=SEED)

    def work(token: Any) -> dict:
        return library.pycolmap.global_mapping(database, output, output, options=options)

    return work


def _incremental_options(options: Mapping) -> Any:
    chosen = library.pycolmap.IncrementalPipelineOptions(random_seed=SEED, min_model_size=3, extract_colors=False)
    chosen.mapper.init_min_tri_angle = options.first_angle
    chosen.mapper.abs_pose_min_num_inliers = options.least_matches
    return chosen
