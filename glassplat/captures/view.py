"""Photographs with cameras, panes and estimated normals, read lazily; and coloured points.

Estimated normals are the output of monocular networks: x to the right, y up, z towards the camera. A PNG of 8 or 16
bits holds (n + 1) / 2, an NPY file [H, W, 3] of floats the vectors themselves.

Pixels are cached in memory up to a budget, and are read ahead of the step that needs them. The pixels read first stay,
as long as there is room: every epoch visits each view once, so recently used pixels are not more likely to be used
again. A small part of the budget holds pixels read ahead for the next steps, and evicts the oldest. Pixels that were
costly to undistort or to reduce are kept on disk during training.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import IO, Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.captures import cameras
from glassplat.captures.capture import RawPoints, Shot
from glassplat.captures.masks import Mask
from glassplat.errors import InputError, convert_to_input_error
from glassplat.files.images import image_size, read_colors, read_image_float
from glassplat.options import WHITE, Rgb
from glassplat.scene.camera import Camera, to_device

GIGABYTE = 1e9
"""Bytes."""
MEMORY_SHARE = 0.25
"""Default share of the machine's memory for photographs."""
UNKNOWN_MEMORY = 8 * GIGABYTE
"""Assumed memory of a machine that does not report it."""
MOST_AHEAD = 8
"""Maximum number of views read ahead: a step is rarely shorter than an eighth of the reading time."""
AHEAD_SHARE = 0.25
"""Largest share of the budget for pixels read ahead, regardless of the number of views."""
PIXEL_BYTES = 5
"""Bytes per pixel of a view: three of the photograph, one of the pane labels, one of the ignore mask."""
MOST_THREADS = 4
"""Maximum number of threads that read photographs."""
DISK_RATE = 2e8
"""Bytes per second of a slow disk."""
DISK_RESERVE = 5 * GIGABYTE
"""Bytes of disk space that photographs leave free, because training writes there, too."""
CGROUP_FILE, CGROUP_FOLDER = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
"""Linux files that list the control groups of this process, and the folder of their limits."""
LIMIT_FILES = {"": "memory.max", "memory": "memory.limit_in_bytes"}
"""Names of the limit files by controller of a group: cgroup v2 has no controller name."""

Item = TypeVar("Item")


def sample_evenly(items: Sequence[Item], most: int) -> list[Item]:
    """At most `most` of the items, evenly spread."""
    count = min(most, len(items))
    return [items[len(items) * number // count] for number in range(count)]


Reader = Callable[[], Tensor]
"""Reads pixels, the same ones every time; caches store them by their reader, which is compared by identity."""


class DiskCache:
    """Disk cache of undistorted and reduced pixels, in an unnamed file that disappears with the process.

    If the disk is full or not writable, nothing more is stored, and photographs are read from their own files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._entries: dict[Reader, tuple[int, tuple[int, ...], np.dtype[np.generic]]] = {}
        self._is_full = False
        self._lock = Lock()

    def put(self, reader: Reader, pixels: Tensor) -> None:
        """Stores the pixels of a reader if there is room."""
        values = pixels.numpy()
        with self._lock:
            if self._is_full or reader in self._entries:
                return
            try:
                if shutil.disk_usage(self._folder).free < values.nbytes + DISK_RESERVE:
                    self._is_full = True
                    return
                self._file = self._file or tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115
                offset = self._file.seek(0, os.SEEK_END)
                self._file.write(values.tobytes())
                self._file.flush()
            except OSError:
                self._release()  # Under a quota, this space may be needed for a checkpoint.
                return
            self._entries[reader] = offset, values.shape, values.dtype

    def get(self, reader: Reader) -> Tensor | None:
        """The pixels of a reader; None if they are not stored."""
        with self._lock:
            if self._file is None or reader not in self._entries:
                return None
            offset, shape, dtype = self._entries[reader]
            values = np.empty(shape, dtype)
            try:
                self._file.seek(offset)
                is_whole = self._file.readinto(values.reshape(-1).view(np.uint8)) == values.nbytes  # type: ignore[attr-defined]
            except OSError:
                is_whole = False
        return torch.from_numpy(values) if is_whole else None

    def close(self) -> None:
        """Releases the disk space."""
        with self._lock:
            self._release()

    def _release(self) -> None:
        self._entries.clear()
        self._is_full = True
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):  # Closing flushes unwritten data again.
                file.close()


class PixelCache:
    """In-memory cache of pixels; thread-safe.

    Attributes:
        budget: bytes of all pixels together; the pixels of a single step are read even if they exceed it.
        ahead: number of views worth reading ahead of the current step.
    """

    def __init__(self, budget: float | None = None, *, largest: int = 0) -> None:
        """Starts empty.

        Args:
            budget: bytes; by default a share of the machine's memory.
            largest: pixels of the largest view.
        """
        self.budget = default_budget() if budget is None else budget
        self._largest = largest
        view = max(largest * PIXEL_BYTES, 1)
        self.ahead = int(max(min(self.budget * AHEAD_SHARE / view - 1, MOST_AHEAD), 1))
        self._free_bytes = self.budget - (self.ahead + 1) * view
        self._transient_limit = (self.ahead + 1) * view
        self._resident: dict[Reader, Tensor] = {}
        self._transient: OrderedDict[Reader, Tensor] = OrderedDict()
        self._transient_bytes = 0
        self._pending: dict[Reader, Future[Tensor]] = {}
        self._disk_cache: DiskCache | None = None
        self._lock = Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies, also in other processes, start empty and read pixels again."""
        return partial(PixelCache, self.budget, largest=self._largest), ()

    @property
    def is_full(self) -> bool:
        """Return whether some pixels had to be kept temporarily, because there is no more room."""
        return bool(self._transient)

    def get(self, reader: Reader) -> Tensor:
        """The pixels of a reader, read now unless they are cached or being read.

        Raises:
            InputError: they cannot be read.
        """
        with self._lock:
            if (found := self._look_up(reader)) is not None:
                return found
            is_mine = reader not in self._pending
            future = self._pending.setdefault(reader, Future())
        if is_mine:
            self._read(reader, future)
        return future.result()

    def read_ahead(self, reader: Reader) -> None:
        """Reads pixels in a background thread; after a failure, `get` reads them again and raises the error."""
        with self._lock:
            if reader in self._pending or self._look_up(reader) is not None:
                return
            future = self._pending[reader] = Future()
        reading_threads().submit(self._read, reader, future)

    @contextmanager
    def cache_on_disk(self, folder: Path) -> Iterator[None]:
        """Within the context, caches pixels on disk that were costly to read and do not fit in memory."""
        self._disk_cache = disk_cache = DiskCache(folder)
        try:
            yield
        finally:
            self._disk_cache = None
            disk_cache.close()

    def _look_up(self, reader: Reader) -> Tensor | None:
        if reader in self._transient:
            self._transient.move_to_end(reader)
        return self._resident.get(reader, self._transient.get(reader))

    @torch.inference_mode(False)  # The first caller may not need gradients; a later one may.
    def _read(self, reader: Reader, future: Future[Tensor]) -> None:
        disk_cache = self._disk_cache
        try:
            stored = None if disk_cache is None else disk_cache.get(reader)
            begun = time.thread_time()
            pixels = reader() if stored is None else stored
            is_costly = stored is None and time.thread_time() - begun > pixels.nbytes / DISK_RATE
        except BaseException as error:  # noqa: BLE001 - Raised by `get`.
            with self._lock:
                del self._pending[reader]
            future.set_exception(error)
            return
        with self._lock:
            del self._pending[reader]
            stays = self._store(reader, pixels)
        future.set_result(pixels)
        if disk_cache is not None and is_costly and not stays:
            disk_cache.put(reader, pixels)

    def _store(self, reader: Reader, pixels: Tensor) -> bool:
        """Caches pixels; returns whether they stay permanently."""
        size = pixels.numel() * pixels.element_size()
        if size <= self._free_bytes:
            self._free_bytes -= size
            self._resident[reader] = pixels
            return True
        self._transient[reader] = pixels
        self._transient_bytes += size
        while self._transient_bytes > self._transient_limit and len(self._transient) > 1:
            _, oldest = self._transient.popitem(last=False)
            self._transient_bytes -= oldest.numel() * oldest.element_size()
        return False


@cache
def reading_threads() -> ThreadPoolExecutor:
    """The threads that read ahead, shared by all captures; idle threads sleep."""
    return ThreadPoolExecutor(min(os.cpu_count() or 1, MOST_THREADS), thread_name_prefix="photographs")


def default_budget() -> float:
    """Bytes for photographs per process: a share of the memory of the machine or its container."""
    return MEMORY_SHARE * machine_memory() / max(int(os.environ.get("LOCAL_WORLD_SIZE", "1")), 1)


def machine_memory() -> float:
    """Bytes of memory of the machine, or the limit of a container, a service or a scheduler's job."""
    try:
        whole = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # Not available on Windows.
        whole = UNKNOWN_MEMORY
    lines = CGROUP_FILE.read_text(encoding="utf-8", errors="replace").splitlines() if CGROUP_FILE.is_file() else []
    for _, controllers, name in (line.split(":", 2) for line in lines):
        if controllers in LIMIT_FILES:
            group = CGROUP_FOLDER / controllers / name.lstrip("/")
            for folder in (group, *group.parents):  # In a container, the parents end at the root.
                with suppress(OSError, ValueError):  # No such file, or its limit is `max`.
                    whole = min(whole, float((folder / LIMIT_FILES[controllers]).read_text("utf-8")))
    return whole


@dataclass(frozen=True)
class View:
    """One photograph of the capture.

    Attributes:
        name: unique within the data set, with suffix; `/` between folders.
        camera: float32 pinhole camera of `photo`.
        image_path: the file.
        read_photo: returns `photo`.
        read_pane_labels: returns `pane_labels`; None if the view is not annotated.
        read_ignored: returns `ignored`; None if all pixels are used.
        read_normals: returns `normals`; None if there are no estimates.
        memory: pixel cache shared by all views of a capture.
    """

    name: str
    camera: Camera
    image_path: Path
    read_photo: Reader
    read_pane_labels: Reader | None = None
    read_ignored: Reader | None = None
    read_normals: Reader | None = None
    memory: PixelCache = field(default_factory=lambda: PixelCache(math.inf), repr=False, compare=False)

    def __repr__(self) -> str:
        return f"View({self.name!r}, {self.camera})"

    @property
    def photo(self) -> Tensor:
        """[H, W, 3] uint8 sRGB, undistorted and reduced; cached in memory if there is room.

        Raises:
            InputError: the file cannot be read; the message names it.
        """
        return self.memory.get(self.read_photo)

    @property
    def pane_labels(self) -> Tensor | None:
        """[H, W] uint8 pane label per pixel, 0 for no pane; None if the view is not annotated."""
        return None if self.read_pane_labels is None else self.memory.get(self.read_pane_labels)

    @property
    def mask_paths(self) -> list[Path]:
        """Files of its masks, of panes and of ignored pixels, apart from the photograph."""
        readers = (self.read_pane_labels, *getattr(self.read_ignored, "masks", ()))
        paths = [reader.mask.path for reader in readers if isinstance(reader, MaskFile)]
        return [path for path in paths if path != self.image_path]

    @property
    def ignored(self) -> Tensor | None:
        """[H, W] bool, the pixels excluded from training and evaluation; None if there are none."""
        return None if self.read_ignored is None else self.memory.get(self.read_ignored)

    @property
    def normals(self) -> Tensor | None:
        """[H, W, 3] estimated unit normals in camera axes, zero where unknown; None if there is no file.

        Raises:
            InputError: the file cannot be read, or its aspect ratio differs from the photograph's.
        """
        return None if self.read_normals is None else self.memory.get(self.read_normals)

    def read_ahead(self) -> None:
        """Reads the pixels for training on this view in background threads."""
        for reader in (self.read_photo, self.read_pane_labels, self.read_ignored):
            if reader is not None:
                self.memory.read_ahead(reader)

    @property
    def is_annotated(self) -> bool:
        """Return whether there is a pane mask, without reading it."""
        return self.read_pane_labels is not None

    def with_camera(self, camera: Camera) -> View:
        """The same photograph with another camera; cached pixels stay valid."""
        other = copy(self)
        object.__setattr__(other, "camera", camera)
        return other

    @staticmethod
    def in_memory(name: str, camera: Camera, *, photo: Tensor, pane_labels: Tensor | None = None) -> View:
        """A view of pixels in memory, such as a rendered image: `photo` [H, W, 3] and `pane_labels` [H, W], uint8.

        Raises:
            ValueError: they are not uint8 tensors of the camera's size.
        """
        size = camera.height, camera.width
        for given, shape in ((photo, (*size, 3)), (pane_labels, size)):
            if given is not None and (getattr(given, "dtype", None) != torch.uint8 or given.shape != shape):
                found = f"{given.dtype} {[*given.shape]}" if isinstance(given, Tensor) else f"a {type(given).__name__}"
                raise ValueError(f"the pixels of {name} are {found}; expected a tensor of uint8 {[*shape]}")
        labels = None if pane_labels is None else partial(_return_pixels, pane_labels)
        return View(name, camera, Path(name), partial(_return_pixels, photo), labels)


def _return_pixels(pixels: Tensor) -> Tensor:
    return pixels


@dataclass(frozen=True, eq=False)
class PhotoFile:
    """Reader of the pixels of one view; `background` is seen through transparent pixels.

    Without a background, transparent pixels show their own colours.
    """

    path: Path
    pixel_map: cameras.PixelMap
    background: Rgb | None

    def __call__(self) -> Tensor:
        """[H, W, 3] uint8 in the pixel grid of the view's camera."""
        with convert_to_input_error():
            pixels = read_colors(self.path)
        return torch.from_numpy(self.pixel_map.map_photo(_composite_over(pixels, self.background)))


@dataclass(frozen=True, eq=False)
class MaskFile:
    """Reader of the labels of one view; `size` is the photograph's, before undistortion."""

    mask: Mask
    size: tuple[int, int]
    pixel_map: cameras.PixelMap

    def __call__(self) -> Tensor:
        """[H, W] uint8 in the pixel grid of the view's camera."""
        return torch.from_numpy(self.pixel_map.map_labels(cameras.nearest_resize(self.mask.labels(), *self.size)))

    def ignored(self) -> Tensor:
        """[H, W] uint8, above zero where a pixel of the view covers any labelled pixel."""
        return torch.from_numpy(self.pixel_map.map_ignored(cameras.nearest_resize(self.mask.labels(), *self.size)))


@dataclass(frozen=True, eq=False)
class IgnoredFiles:
    """Reader of the pixels of one view that any of its masks excludes, or that lie outside the photograph."""

    masks: tuple[MaskFile, ...]
    blank: cameras.PixelMap | None = None

    def __call__(self) -> Tensor:
        """[H, W] bool, true where any mask is, or outside the photograph."""
        blank = [] if self.blank is None else [torch.from_numpy(cameras.blank_mask(self.blank))]
        return torch.stack([*blank, *(mask.ignored() for mask in self.masks)]).amax(dim=0) > 0


def prepare_view(
    shot: Shot,
    mask: Mask | None,
    *,
    downscale: float = 1.0,
    background: Rgb | None = WHITE,
    ignored: Sequence[Mask] = (),
    normals: Path | None = None,
) -> tuple[View, bool]:
    """Checks one photograph against its camera and sets up its readers; decodes no pixels.

    Args:
        shot: the photograph.
        mask: of its panes.
        downscale: width and height are divided by it and rounded.
        background: sRGB in [0, 1] behind transparent pixels; None keeps their own colours.
        ignored: masks of pixels to ignore.
        normals: file of its estimated normals.

    Returns:
        The view, and true if its intrinsics were rescaled to the size of the image file.

    Raises:
        InputError: unreadable file, inconsistent sizes, non-rigid pose, or lens that cannot be undistorted.
    """
    with convert_to_input_error():
        width, height = image_size(shot.image_path)
    lens = cameras.lens_for_image(shot.lens, (width, height), shot.name)
    pinhole, distorted = cameras.pinhole_of(lens)
    small = _reduced_size(pinhole, downscale, shot.name)
    pixel_map = cameras.PixelMap(lens if distorted else None, *small)
    blank = pixel_map if cameras.blank_share(lens) else None
    pose = torch.from_numpy(cameras.rigid_pose(shot.cam_from_world, shot.name)).float()
    fx, fy, cx, cy = pinhole.parameters
    camera = Camera(pose, fx, fy, cx, cy, pinhole.width, pinhole.height).resize(*small)
    view = View(
        name=shot.name,
        camera=camera,
        image_path=shot.image_path,
        read_photo=PhotoFile(shot.image_path, pixel_map, background),
        read_pane_labels=None if mask is None else _mask_file(mask, (width, height), pixel_map),
        read_ignored=IgnoredFiles(tuple(_mask_file(one, (width, height), pixel_map) for one in ignored), blank)
        if ignored or blank
        else None,
        read_normals=normals_reader(normals, camera),
    )
    return view, lens is not shot.lens


def _reduced_size(pinhole: cameras.Lens, downscale: float, name: str) -> tuple[int, int]:
    """Width and height of a photograph reduced by a factor.

    Raises:
        InputError: it would be too small for training.
    """
    width, height = (max(1, round(side / downscale)) for side in (pinhole.width, pinhole.height))
    least = cameras.LEAST_SIDE
    if downscale > 1 and min(width, height) < least:
        most = max(min(pinhole.width, pinhole.height) / least, 1)
        raise InputError(
            f"{name} is {pinhole.width}x{pinhole.height} pixels, and {width}x{height} reduced by {downscale:g}; "
            f"expected at least {least} pixels along each side: use --downscale {int(10 * most) / 10:g} or less"
        )
    return width, height


def _mask_file(mask: Mask, size: tuple[int, int], pixel_map: cameras.PixelMap) -> MaskFile:
    """The mask at the photograph's size, which it must have up to an integer factor."""
    with convert_to_input_error():
        mask_size = image_size(mask.path)
    if not (_is_multiple(mask_size, size) or _is_multiple(size, mask_size)):
        raise InputError(
            f"mask {mask.path} is {mask_size[0]}x{mask_size[1]} pixels, its photograph {size[0]}x{size[1]}; "
            "expected the same size, or one an integer multiple of the other"
        )
    return MaskFile(mask, size, pixel_map)


def _is_multiple(large: tuple[int, int], small: tuple[int, int]) -> bool:
    """Return whether one size is an integer multiple of the other, up to the rounding of the smaller one."""
    factor = round(large[0] / small[0])
    return factor >= 1 and all(
        abs(a / factor - b) < min(1, cameras.MOST_SKEW * b) and (factor > 1 or a == b)
        for a, b in zip(large, small, strict=True)
    )


def _composite_over(pixels: NDArray[np.uint8], background: Rgb | None) -> NDArray[np.uint8]:
    """[H, W, 3] from grey, RGB or RGBA, composited over the background if there is one."""
    if pixels.shape[2] == 1:
        return np.repeat(pixels, 3, axis=2)
    if pixels.shape[2] == 3 or background is None:
        return np.ascontiguousarray(pixels[:, :, :3])
    behind = np.asarray(background, dtype=np.float32) * 255
    opaque = np.empty((*pixels.shape[:2], 3), dtype=np.uint8)
    for row, seen in enumerate(pixels):  # Row by row, because floats take four times the memory.
        alpha = seen[:, 3:].astype(np.float32) / 255
        opaque[row] = np.round(seen[:, :3] * alpha + behind * (1 - alpha))
    return opaque


NORMALS_FOLDER = "normals"
NORMALS_SUFFIXES = (".png", ".npy")
CAMERA_FROM_NORMAL_MAP = (1.0, -1.0, -1.0)
"""Signs that convert y up and z towards the camera to y down and z forward."""
LEAST_LENGTH = 0.5
"""Shorter vectors, such as those of grey or black pixels, are not normals."""


def estimated_normals(view: View) -> Tensor | None:
    """[H, W, 3] unit normals of a view in world axes, zero where unknown; None if there is no file.

    Raises:
        InputError: as `View.normals`.
    """
    normals = view.normals
    return None if normals is None else rotate_to_world(normals, view.camera)


def rotate_to_world(normals: Tensor, camera: Camera) -> Tensor:
    """Vectors [..., 3] rotated from camera to world axes; differentiable in the camera's pose."""
    return normals @ camera.cam_from_world[:3, :3].to(normals)


def normals_reader(path: Path | None, camera: Camera) -> Reader | None:
    """Reader of a file of estimated normals, at a camera's size; None for None."""
    return None if path is None else partial(read_normals_file, path, camera)


def read_normals_file(path: Path, camera: Camera) -> Tensor:
    """[H, W, 3] unit normals in camera axes at a camera's size, zero where unknown.

    The file belongs to the undistorted photograph, like `View.photo`.

    Raises:
        InputError: the file cannot be read, or its aspect ratio differs from the camera's.
    """
    with convert_to_input_error():
        vectors = _read_vectors(path)
    height, width = vectors.shape[:2]
    cameras.check_proportions(path, (width, height), (camera.width, camera.height))
    batch = torch.from_numpy(vectors).permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(batch, (camera.height, camera.width), mode="area")[0].permute(1, 2, 0)
    known = small.norm(dim=-1, keepdim=True) > LEAST_LENGTH
    unit = torch.nn.functional.normalize(small, dim=-1) * torch.tensor(CAMERA_FROM_NORMAL_MAP, dtype=torch.float32)
    return torch.where(known, unit, 0)


def normals_paths(photographs: Mapping[str, Path]) -> dict[str, Path]:
    """Files of estimated normals by name of the photograph; photographs without one are left out.

    The file of `left/3.jpg` is `left/3.png` in a folder `normals` inside or next to the folder of photographs, or
    `3.png` in a folder `normals` next to the photograph. If the stem 3 is unique, `3.png` in a folder `normals` of the
    photographs or next to `left` is found, too. Names may also be `3.npy`, `3.jpg.png` or `3.jpg.npy`.

    Args:
        photographs: path of every photograph of a capture by name.
    """
    stems = Counter(path.stem for path in photographs.values())
    is_folder = cache(Path.is_dir)  # Cached: most captures have none, and thousands of photographs are tested.
    found = {}
    for name, path in photographs.items():
        whole, alone = PurePosixPath(name), PurePosixPath(path.name)
        if whole.anchor or ".." in whole.parts or path.parts[-len(whole.parts) :] != whole.parts:
            whole = alone  # The folders of the name are not those of the path.
        base = path.parents[len(whole.parts) - 1]
        places = [(base, whole), (base.parent, whole), (path.parent, alone)]
        if stems[path.stem] == 1:
            places += [(path.parent.parent, alone), (base, alone)]
        found_in = [(folder / NORMALS_FOLDER, one) for folder, one in places if is_folder(folder / NORMALS_FOLDER)]
        names = [folder / one.parent / stem for folder, one in found_in for stem in (one.stem, one.name)]
        files = (file.with_name(f"{file.name}{suffix}") for file in names for suffix in NORMALS_SUFFIXES)
        file = next(filter(Path.is_file, files), None)
        if file is not None:
            found[name] = file
    return found


def _read_vectors(path: Path) -> NDArray[np.float32]:
    """[H, W, 3] as stored, with non-finite values set to zero."""
    if path.suffix == ".png":
        pixels = read_image_float(path)
        if pixels.shape[2] < 3:
            raise ValueError(f"{path} is grey; expected normals as colours")
        vectors = 2 * pixels[..., :3] - 1
        return vectors * (pixels[..., 3:] > LEAST_LENGTH) if pixels.shape[2] == 4 else vectors
    try:
        with path.open("rb") as file:  # Not `numpy.load`, which opens archives, too.
            vectors = np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:  # NumPy evaluates the header, and damaged ones raise various errors.
        raise ValueError(f"{path} is not an array that NumPy can read ({error}); save it with numpy.save") from error
    if vectors.ndim != 3 or vectors.shape[2] != 3 or vectors.dtype.kind != "f" or 0 in vectors.shape:
        raise ValueError(f"{path} holds {vectors.dtype} of shape {list(vectors.shape)}; expected floats [H, W, 3]")
    return np.nan_to_num(vectors.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Coloured points in world space.

    Attributes:
        positions: [P, 3] float32, world units.
        colors: [P, 3] uint8 sRGB.
    """

    positions: Tensor
    colors: Tensor

    def __post_init__(self) -> None:
        expected = (self.positions.shape[0], 3)
        if tuple(self.positions.shape) != expected or tuple(self.colors.shape) != expected:
            raise ValueError(
                f"expected positions and colors of shape [P, 3], got {list(self.positions.shape)} and "
                f"{list(self.colors.shape)}"
            )
        if self.positions.dtype != torch.float32 or self.colors.dtype != torch.uint8:
            raise TypeError(
                f"expected float32 positions and uint8 colors, got {self.positions.dtype}, {self.colors.dtype}"
            )

    def __len__(self) -> int:
        return self.positions.shape[0]

    @staticmethod
    def of(points: RawPoints) -> PointCloud:
        """Points that share the memory of those read."""
        return PointCloud(torch.from_numpy(points.positions), torch.from_numpy(points.colors))


def copy_ignored_pixels(image: Tensor, view: View) -> Tensor:
    """An image [H, W, 3] with ignored pixels taken from the photograph: no error, no gradient."""
    if view.ignored is None:
        return image
    photo = to_device(view.photo, image.device).to(image.dtype) / 255
    return torch.where(to_device(view.ignored, image.device)[..., None], photo, image)
