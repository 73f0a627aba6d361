"""Photographs, poses, masks and points of one capture, independent of its format."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from os.path import lexists
from pathlib import Path
from statistics import median_low
from threading import Event

import torch

from glassplat.captures.axes import axes_evidence
from glassplat.captures.cameras import blank_share
from glassplat.captures.capture import Capture
from glassplat.captures.files import CaptureFiles, read_capture
from glassplat.captures.masks import IGNORE_FOLDER, MASK_FOLDER, PLANES, Mask, Polarity, ignored_share, read_transparent
from glassplat.captures.transforms import points_in_view
from glassplat.captures.view import (
    GIGABYTE,
    PixelCache,
    PointCloud,
    View,
    normals_paths,
    prepare_view,
    sample_evenly,
)
from glassplat.errors import InputError, convert_to_input_error, count_noun, join_names
from glassplat.files.images import is_transparent
from glassplat.files.records import LARGEST_COORDINATE
from glassplat.files.sidecars import read_planes
from glassplat.options import WHITE, Rgb
from glassplat.scene.camera import Camera
from glassplat.scene.panes import Planes, in_image
from glassplat.scene.scene import Scene

SAMPLES = 9
"""Sample points along each side of a rectangle, for testing its visibility in the photographs."""


def read_capture_planes(root: Path, cameras: Sequence[Camera]) -> Planes | None:
    """The pane rectangles that a capture provides, in its own frame; None if there are none.

    Args:
        root: the capture's folder.
        cameras: its training cameras; each pane must be visible to at least one.
    """
    path = root / PLANES
    if not lexists(path):
        return None
    with convert_to_input_error():
        planes = read_planes(path)
    for row, label in enumerate(planes.labels):
        points = rectangle_points(planes.select([row]))
        if not any(in_image(points, camera).any() for camera in cameras):
            raise InputError(
                f"no photograph shows pane {label} of {path}; expected a rectangle in the capture's own frame: mark it "
                "again, or remove it from the file"
            )
    return planes if len(planes) else None


def rectangle_points(plane: Planes) -> torch.Tensor:
    """[P, 3] points spread evenly over the rectangle of one plane, including its corners."""
    (tangent,), (bitangent,) = plane.axes()
    steps = torch.linspace(-1, 1, SAMPLES, dtype=torch.float32)
    u, v = torch.meshgrid(steps, steps, indexing="ij")
    half_u, half_v = plane.half_sizes[0]
    return plane.centers[0] + u.reshape(-1, 1) * half_u * tangent + v.reshape(-1, 1) * half_v * bitangent


__all__ = ["Dataset", "PointCloud", "View", "load_dataset"]

TEST_EVERY, EXTENT_MARGIN = 8, 1.1
"""Interval between test views, and the extent in largest distances of a camera from their mean, both as in 3DGS."""
FARTHEST_ORIGIN = 1e3
"""Distance of the cameras from the origin, in extents, at which float32 moves them by up to 1e-4 extents."""
SAME_POSITION = 1e-6
"""Share of the cameras' distance from the origin below which distances between them are rounding."""
NERFSTUDIO_POINTS = "colmap/sparse/0/points3D.bin"
"""Path of the COLMAP model from which nerfstudio takes its poses."""
MUCH_BLANK = 0.01
"""Share of an undistorted photograph outside the field of view of its lens, above which a warning is given."""
FEW_MASKS = 4
"""Photographs whose masks are decoded while a capture is loaded."""
MUCH_IGNORED = 0.7
"""Ignored share of the photographs above which a warning is given."""
LEAST_RADIUS = 1e-9
"""Smallest radius of the cameras, world units; the square of a smaller one is lost in float32."""


@dataclass(frozen=True)
class Dataset:
    """One capture, split for training and testing.

    Attributes:
        root: folder of the capture.
        train: training views, sorted by name; at least two.
        test: held-out views, sorted by name; may be empty.
        points: sparse points in the capture's own frame.
        extent: 1.1 x the largest distance of a training camera from their mean; world units.
        pane_labels: all labels in the masks, ascending.
        truth: folder of ground-truth layers and planes for evaluation; None if the capture has none.
        warnings: assumptions and ignored data, in full sentences.
        split: rule by which the test views were chosen.
        measured_points: False if `points` are random and carry no geometry.
        background: sRGB behind transparent pixels; None if there are no such pixels, or if they are ignored.
        planes: panes that the capture provides as rectangles; their masks, if any, only refine them.
        downscale: factor by which the photographs were reduced.
        mask_polarity: which value of binary masks marks the pane, as given to the reader.
    """

    root: Path
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: PointCloud
    extent: float
    pane_labels: tuple[int, ...] = ()
    truth: Path | None = None
    warnings: tuple[str, ...] = ()
    split: str = ""
    measured_points: bool = True
    background: Rgb | None = None
    planes: Planes | None = None
    downscale: float = 1.0
    mask_polarity: Polarity = "auto"

    @property
    def memory(self) -> PixelCache:
        """Cache of the pixels of its views."""
        return self.train[0].memory

    @property
    def photograph_pixels(self) -> int:
        """Number of pixels of a training photograph of median size."""
        return median_low(view.camera.width * view.camera.height for view in self.train)

    @property
    def photograph_bytes(self) -> int:
        """Memory required by all training photographs, in bytes."""
        return sum(3 * view.camera.width * view.camera.height for view in self.train)

    def __repr__(self) -> str:
        return (
            f"Dataset({str(self.root)!r}: {len(self.train)} training and {count_noun(len(self.test), 'test view')}, "
            f"{len(self.points.positions)} points, panes {self.pane_labels})"
        )


def load_dataset(
    root: Path | str,
    *,
    downscale: float = 1.0,
    background: Rgb = WHITE,
    mask_polarity: Polarity = "auto",
    memory: float | None = None,
) -> Dataset:
    """Read a capture: COLMAP, Mirror-NeRF, or transforms.json in any dialect; photographs are decoded later.

    Args:
        root: the capture's folder.
        downscale: photographs are reduced by this factor, at least 1.
        background: sRGB in [0, 1] behind transparent pixels; COLMAP captures ignore these pixels instead.
        mask_polarity: which value of binary masks marks the pane.
        memory: gigabytes of photographs kept in memory; a quarter of the machine's memory if not given.

    Raises:
        FileNotFoundError: no such folder.
        InputError: unknown format, or unusable capture; the message gives the reason.
    """
    check_downscale(downscale)
    files = read_capture(root, mask_polarity=mask_polarity)
    return make_dataset(files, downscale=downscale, background=background, memory=memory)


def check_dataset(dataset: Dataset) -> None:
    """Raise an InputError for anything but a `Dataset`, such as a path."""
    if not isinstance(dataset, Dataset):
        raise InputError(f"dataset is {dataset!r}; expected what `glassplat.load_dataset` returns for a capture")


def check_downscale(downscale: float) -> None:
    """Raise an InputError for a factor below 1 or not finite."""
    if not math.isfinite(downscale) or downscale < 1:
        raise InputError(f"downscale is {downscale}; expected a number of at least 1")


def make_dataset(
    files: CaptureFiles, *, downscale: float = 1.0, background: Rgb = WHITE, memory: float | None = None
) -> Dataset:
    """Make a `Dataset`, as `load_dataset` does, from a capture that `read_capture` read."""
    check_downscale(downscale)
    root, capture, shots, masks = files.root, files.capture, files.shots, files.masks
    with convert_to_input_error():
        transparent = any(is_transparent(shot.image_path) for shot in shots)
    ignores_transparent = transparent and capture.ignores_transparent
    transparent_masks = {s.name: [Mask(s.image_path, read_transparent)] for s in shots if ignores_transparent}
    shown = background if transparent and not ignores_transparent else None
    normals = normals_paths({shot.name: shot.image_path for shot in shots})
    prepared = [
        prepare_view(
            shot,
            masks.masks.get(shot.name),
            downscale=downscale,
            background=None if ignores_transparent else background,
            ignored=(*files.ignored.get(shot.name, ()), *transparent_masks.get(shot.name, ())),
            normals=normals.get(shot.name),
        )
        for shot in shots
    ]
    train, test, split = _split_views(_share_cache([view for view, _ in prepared], memory), capture)
    points, point_warnings = _points_and_warnings(root, capture, train)
    extent = _extent(train)
    measured = capture.points is not None
    _check_axes(train, points if measured else None, capture.format_name)
    warnings = (
        *capture.warnings,
        *masks.warnings,
        *_view_warnings(files, [view.name for view, is_rescaled in prepared if is_rescaled], shown),
        *(["Transparent pixels of the photographs are ignored."] if ignores_transparent else ()),
        *point_warnings,
        *far_origin_warnings(torch.stack([view.camera.center for view in train]), extent),
    )
    truth = root / "gt"
    return Dataset(
        root=root,
        train=train,
        test=test,
        points=points,
        extent=extent,
        pane_labels=masks.labels,
        truth=truth if truth.is_dir() else None,
        warnings=warnings,
        split=split,
        measured_points=measured,
        background=shown,
        planes=read_capture_planes(root, [view.camera for view in train]),
        downscale=downscale,
        mask_polarity=files.mask_polarity,
    )


def _share_cache(views: list[View], gigabytes: float | None) -> list[View]:
    """The views with one shared memory of the given budget; by default a share of the machine's memory."""
    largest = max((view.camera.width * view.camera.height for view in views), default=0)
    shared = PixelCache(None if gigabytes is None else gigabytes * GIGABYTE, largest=largest)
    return [replace(view, memory=shared) for view in views]


def _check_axes(train: tuple[View, ...], points: PointCloud | None, format_name: str) -> None:
    """Raise an InputError if the scene lies behind the cameras, but in front of them with flipped axes."""
    evidence = axes_evidence(train, None if points is None else points.positions)
    if evidence is not None and evidence.contradicts:
        raise InputError(
            f"the cameras of the {format_name} capture look away from the scene: {evidence.as_read:.0%} of the "
            f"{evidence.source} lie in front of them, {evidence.flipped:.0%} if they looked the other way. Expected +y "
            "down and +z forward in a COLMAP model, +y up and -z forward in transforms.json; turn the y and z axes of "
            "the poses round"
        )


def _split_views(views: list[View], capture: Capture) -> tuple[tuple[View, ...], tuple[View, ...], str]:
    """Training views, test views (both sorted by name) and a description of the split."""
    if capture.test_shots is None:
        held_out = {view.name for view in views[::TEST_EVERY]}
        split = f"every {TEST_EVERY}th image by name"
    else:
        held_out = {shot.name for shot in capture.test_shots}
        split = "shipped with the data"
    train = tuple(view for view in views if view.name not in held_out)
    test = tuple(view for view in views if view.name in held_out)
    if len(train) < 2:
        raise InputError(
            f"{len(train)} of {len(views)} photographs are left for training (test views: {split}); "
            "expected at least two"
        )
    return train, test, split


def _extent(train: tuple[View, ...]) -> float:
    """1.1 x the largest distance of a training camera from their mean; world units."""
    centers = torch.stack([view.camera.center.double() for view in train])
    radius = float((centers - centers.mean(0)).norm(dim=1).max())
    if radius <= max(SAME_POSITION * float(centers.norm(dim=1).max()), LEAST_RADIUS):
        raise InputError(
            f"all training cameras are at one point, {_rounded(centers)}, as far as single precision distinguishes; "
            "expected photographs from different positions, near the origin: shift a georeferenced capture"
        )
    return EXTENT_MARGIN * radius


def far_origin_warnings(centers: torch.Tensor, extent: float) -> tuple[str, ...]:
    """Warning if the coordinates of cameras [V, 3] are too large for float32 to resolve a scene of this extent."""
    centers = centers.double()
    ratio = float(centers.mean(0).norm()) / extent
    if ratio <= FARTHEST_ORIGIN:
        return ()
    return (
        f"The cameras are {ratio:.0f} scene extents away from the origin, where single precision blurs the scene; "
        f"subtract {_rounded(centers)} from all positions of the capture, and add it to results that need it.",
    )


def _rounded(centers: torch.Tensor) -> str:
    """The mean of positions [V, 3] as text, with seven digits."""
    return f"({', '.join(f'{value:.7g}' for value in centers.mean(0).tolist())})"


def _points_and_warnings(root: Path, capture: Capture, train: tuple[View, ...]) -> tuple[PointCloud, list[str]]:
    """The capture's points, or random ones with a warning."""
    if capture.points is None:
        make = capture.random_points or (lambda: points_in_view([view.camera for view in train]))
        points = PointCloud.of(make())
        warning = f"The {capture.format_name} capture has no points; {len(points)} random points are used instead."
        if (path := root / NERFSTUDIO_POINTS).is_file():
            folder = path.parents[2]
            warning += (
                f" Those of {path} are not read: make a sparse_pc.ply of them, named by ply_file_path, with a newer "
                f"ns-process-data; or read the COLMAP model, {folder}, with the photographs linked as "
                f"{folder / 'images'}."
            )
        return points, [warning]
    found = PointCloud.of(capture.points)
    # Comparisons with NaN are false.
    usable = (found.positions.abs() <= LARGEST_COORDINATE).all(dim=1)
    if usable.all():
        return found, []
    kept = PointCloud(found.positions[usable], found.colors[usable])
    if not len(kept):
        raise InputError(f"no point of the capture is finite and within {LARGEST_COORDINATE:g}; export the model again")
    return kept, [f"{int((~usable).sum())} points are ignored: non-finite, or beyond {LARGEST_COORDINATE:g}."]


def _view_warnings(files: CaptureFiles, rescaled: list[str], background: Rgb | None) -> Iterator[str]:
    """Warnings about lenses, transparent pixels and masks, each for all photographs; decodes only a few masks."""
    if rescaled:
        yield (
            f"Intrinsics were scaled for {join_names(rescaled)}, because these are scaled copies of the calibrated "
            "photographs."
        )
    if background is not None:
        yield f"The photographs have transparent pixels; they are laid over sRGB {background}."
    blank = max(blank_share(shot.lens) for shot in files.shots)
    if blank > MUCH_BLANK:
        yield (
            f"The lens is so wide that up to {blank:.1%} of an undistorted photograph was outside its view; these "
            "pixels are ignored."
        )
    names = sample_evenly(sorted(files.ignored), FEW_MASKS)
    shares = [ignored_share(files.ignored[name]) for name in names]
    share = sum(shares) / max(len(shares), 1) * len(files.ignored) / len(files.shots)
    if share > MUCH_IGNORED:
        meaning = f"black in {MASK_FOLDER}/ is ignored, and white in {IGNORE_FOLDER}/; are the masks inverted?"
        if all(shot.name in files.ignored and ignored_share(files.ignored[shot.name]) == 1 for shot in files.shots):
            raise InputError(f"masks exclude all pixels of all photographs of {files.root}: {meaning}")
        yield f"Masks exclude about {share:.0%} of the photographs: {meaning}"


@torch.no_grad()
def with_corrected_cameras(dataset: Dataset, scene: Scene) -> Dataset:
    """The capture with the scene's pose corrections applied; the same object if there are none.

    Test views have no corrections of their own: theirs are interpolated from the neighbouring photographs by name.

    Args:
        dataset: as it was read.
        scene: its `poses` were optimised on this capture.
    """
    if not len(scene.poses):
        return dataset

    def corrected(view: View) -> View:
        camera = scene.poses.interpolate(view.name).correct(view.camera, view.name, scene.extent)
        return view if camera is view.camera else view.with_camera(detached_camera(camera))

    return replace(dataset, train=tuple(map(corrected, dataset.train)), test=tuple(map(corrected, dataset.test)))


def detached_camera(camera: Camera) -> Camera:
    """The camera on the CPU, detached from the autograd graph."""
    return replace(camera, cam_from_world=camera.cam_from_world.detach().cpu())


@contextmanager
def read_photographs_in_background(dataset: Dataset) -> Iterator[Callable[[], None]]:
    """Read photographs in a background thread while the context lasts, one after the other.

    Test photographs come first, to find unreadable ones before training ends, and are not kept. Training photographs
    follow until memory is full, because training needs them there anyway. The rest is read ahead of its step.

    Yields:
        A function that raises the InputError of a photograph that could not be read, and otherwise does nothing.
    """
    stop = Event()
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="photographs") as pool:
        reading = pool.submit(_read_all_photographs, dataset, stop)

        def check() -> None:
            if reading.done():
                reading.result()

        try:
            yield check
        finally:
            stop.set()


def _read_all_photographs(dataset: Dataset, stop: Event) -> None:
    for view in dataset.test:
        if stop.is_set():
            return
        view.read_photo()
    for view in dataset.train:
        if stop.is_set() or view.memory.is_full:
            return
        _ = view.photo
