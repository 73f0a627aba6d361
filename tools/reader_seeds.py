"""Seed files for fuzzing readers: small valid files of every kind, as written by glassplat and other programs."""

from __future__ import annotations

import dataclasses
import gzip
import json
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gsply
import numpy as np
import torch
from PIL import Image, ImageCms

from glassplat.annotate.document import ANNOTATIONS, read_document
from glassplat.captures import colmap_library as library
from glassplat.captures.colmap import pose_matrix, read_model
from glassplat.captures.masks import read_mask
from glassplat.captures.transforms import load_transforms
from glassplat.captures.view import View, estimated_normals, normals_reader
from glassplat.files.glb import write_glb
from glassplat.files.images import read_colors
from glassplat.files.ply import write_gaussians
from glassplat.files.scene_folder import read_scene, read_splats, select_drawable, write_scene
from glassplat.files.sidecars import (
    read_cameras,
    read_corrections,
    read_environment,
    read_equirect,
    read_planes,
    write_cameras,
    write_corrections,
    write_environment,
    write_equirect,
    write_planes,
)
from glassplat.files.spz import HEADER, MAGIC, write_spz
from glassplat.methods.recipe import RECIPES, recipe_to_json
from glassplat.model.run_directory import RunDirectory, RunSettings, lines_until
from glassplat.prepare.colmap import FeatureDatabase
from glassplat.prepare.photographs import Photograph
from glassplat.scene.camera import Camera
from glassplat.scene.corrections import Exposures
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Environment, Scene
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.densify import ScreenStatistics
from glassplat.training.stage import Optimizer, TrainState

LARGEST_PICTURE_MIB = 2048
"""Memory needed for 134 megapixels, the largest image that is read."""


@dataclass(frozen=True)
class Reader:
    """A reader of files.

    Attributes:
        name: name of the file passed to it, in its own folder.
        read: reads the file; may raise ValueError or FileNotFoundError.
        seeds: writes seed files into a folder.
        longest: maximum file size, bytes.
        most_mib: maximum memory use, MiB.
    """

    name: str
    read: Callable[[Path], Any]
    seeds: Callable[[Path], None]
    longest: int = 4096
    most_mib: int = 512


def gaussians_of(coefficients: int, count: int = 3) -> Gaussians:
    """A few Gaussians, deterministic."""
    generator = torch.Generator().manual_seed(coefficients)

    def draw(*shape: int) -> torch.Tensor:
        return 0.3 * torch.randn(count, *shape, generator=generator)

    degree = round(coefficients**0.5) - 1
    return Gaussians(draw(3), draw(4), draw(3) - 3, draw(), draw(coefficients, 3), active_sh_degree=degree)


def planes_of() -> Planes:
    """One pane."""
    return Planes.rectangle((0, 0, 2), (0, 0.1, -1), (1, 0.5))


def camera_of() -> Camera:
    """One camera."""
    return Camera.look_at((0, 0, -3), (0, 0, 0), up=(0, -1, 0), width=64, height=48)


def _splats(path: Path) -> None:
    select_drawable(read_splats(path), path)


def _ply_seeds(folder: Path) -> None:
    for coefficients in (1, 4):
        write_gaussians(folder / f"{coefficients}.ply", gaussians_of(coefficients))
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()  # noqa: SIM905
    head = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {name}" for name in names), "end_header"]
    (folder / "ascii.ply").write_text("\n".join([*head, *["0.5 " * len(names)] * 2]) + "\n")


def _compressed_seeds(folder: Path) -> None:
    one = gaussians_of(4)
    values = (one.means, one.log_scales, one.quats, one.logit_opacities, one.sh[:, 0], one.sh[:, 1:])
    gsply.plywrite(str(folder / "a.ply"), *(value.contiguous().numpy() for value in values), compressed=True)


def _spz_seeds(folder: Path) -> None:
    for version in (3, 4):
        write_spz(folder / f"{version}.spz", gaussians_of(4), version)
    for version, size in ((1, 6 + 1 + 3 + 3 + 3), (2, 9 + 1 + 3 + 3 + 3)):
        head = HEADER.pack(MAGIC, version, 2, 0, 12, 0, 0)
        (folder / f"{version}.spz").write_bytes(gzip.compress(head + bytes(range(2 * size)), mtime=0))


def _splat_seeds(folder: Path) -> None:
    row = np.arange(6, dtype="<f4").tobytes() + bytes(range(100, 108))
    (folder / "a.splat").write_bytes(2 * row)


def _scene_seeds(folder: Path) -> None:
    write_scene(folder, Scene(gaussians_of(1), 1.0))
    for file in folder.iterdir():
        if file.name != "scene.json":
            file.unlink()


def _transforms_seeds(folder: Path) -> None:
    frames = [{"file_path": f"images/{index}.png", "transform_matrix": np.eye(4).tolist()} for index in range(2)]
    lens = {"fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    (folder / "a.json").write_text(json.dumps({**lens, "camera_model": "OPENCV", "k1": 0.01, "frames": frames}))
    (folder / "b.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))


COLMAP_PARTS = ("cameras.bin", "images.bin", "points3D.bin")


def _colmap_seeds(folder: Path) -> None:
    cameras = struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 50, 50, 32, 24)
    images = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0" + struct.pack("<Q2dQ", 1, 1, 2, 3)
    points = struct.pack("<QQ3d3BdQ2I", 1, 1, 0, 0, 1, 9, 9, 9, 0.5, 1, 1, 0)
    (folder / "a.bin").write_bytes(b"".join(struct.pack("<I", len(part)) + part for part in (cameras, images, points)))


def _colmap(path: Path) -> None:
    """Splits one file into three, each preceded by its length, and reads the model."""
    data = path.read_bytes()
    for name in COLMAP_PARTS:
        size = struct.unpack("<I", data[:4].ljust(4, b"\0"))[0]
        (path.parent / name).write_bytes(data[4 : 4 + size])
        data = data[4 + size :]
    read_model(path.parent)


TEXT_PARTS = ("cameras.txt", "images.txt", "points3D.txt")
BETWEEN = b"#--\n"
"""Separator of the three files of a text model, which are damaged as one."""


def _text_seeds(folder: Path) -> None:
    parts = (
        "# a comment\n1 PINHOLE 64 48 50 50 32 24\n2 SIMPLE_RADIAL 64 48 50 32 24 0.01\n",
        "1 1 0 0 0 0 0 1 1 a.png\n1 2 3\n2 0.6 0.8 0 0 0 0 1 2 b c.png\n\n",
        "3 0 0 1 9 9 9 0.5 1 0\n",
    )
    (folder / "a.txt").write_bytes(BETWEEN.join(part.encode() for part in parts))


def _colmap_text(path: Path) -> None:
    """Splits one file into three and reads the text model."""
    for name, data in zip(TEXT_PARTS, path.read_bytes().split(BETWEEN, 2), strict=False):
        (path.parent / name).write_bytes(data)
    for image in read_model(path.parent).images:
        pose_matrix(image)


def _features(path: Path) -> FeatureDatabase:
    photographs = [Photograph(Path(f"{index}.png"), f"{index}.png", 64, 48, "", None) for index in range(3)]
    return FeatureDatabase(path, path.parent, photographs)


def _database_seeds(folder: Path) -> None:
    features = _features(folder / "a.db")
    features.create("opencv")
    with closing(library.pycolmap.Database.open(features.path)) as database:
        for image in database.read_all_images():
            database.write_keypoints(image.image_id, np.ones((4, 4), np.float32))
            found = library.pycolmap.FeatureDescriptors(
                library.pycolmap.FeatureExtractorType.SIFT, np.ones((4, 128), np.uint8)
            )
            database.write_descriptors(image.image_id, found)


def _database(path: Path) -> None:
    """Reads the feature database from which an interrupted preparation continues."""
    for suffix in ("-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    features = _features(path)
    features.create("opencv")
    features.feature_counts()
    features.descriptors()


def _transforms(path: Path) -> None:
    capture = load_transforms(path.parent)
    with suppress(FileNotFoundError):
        assert capture is None or capture.shots is not None


def _checkpoint_seeds(folder: Path) -> None:
    scene = Scene(gaussians_of(1), 1.0, planes=planes_of())
    parameters = scene.parameters()
    state = TrainState(
        scene,
        seed=3,
        step=7,
        optimizer=Optimizer(
            {name: (torch.zeros_like(t), torch.ones_like(t)) for name, t in parameters.items()},
            updates=dict.fromkeys(parameters, 7),
        ),
        statistics={"primary": ScreenStatistics.zeros(len(scene.primary))},
        records={"grew": 4.0},
        method="planar",
    )
    save_checkpoint(folder / "a.safetensors", state)


def _recipe_seeds(folder: Path) -> None:
    for method, recipe in RECIPES.items():
        (folder / f"{method}.json").write_text(recipe_to_json(recipe()))


def _settings_seeds(folder: Path) -> None:
    (folder / "a.json").write_text(json.dumps(dataclasses.asdict(RunSettings("/capture", 7000))))


def _log_seeds(folder: Path) -> None:
    (folder / "a.jsonl").write_text("".join(json.dumps({"message": "StepDone", "step": k}) + "\n" for k in range(3)))


def _annotations_seeds(folder: Path) -> None:
    corners = [{"0.png": [1.0, 2.0], "1.png": [3.0, 4.0]} for _ in range(4)]
    stroke = {"kind": "brush", "effect": "cut", "radius": 3.0, "points": [[1.0, 2.0], [3.0, 4.0]]}
    pane = {"label": 1, "material": "glass", "shape": "rectangle", "corners": corners, "edges": []}
    (folder / "a.json").write_text(json.dumps({"version": 1, "panes": [{**pane, "strokes": {"0.png": [stroke]}}]}))


def _picture_seeds(folder: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 4), dtype=np.uint8)
    color = Image.fromarray(pixels[..., :3])
    for suffix in ("png", "jpg", "webp", "bmp", "tif", "gif", "ppm", "tga", "jp2"):
        color.save(folder / f"color.{suffix}")
    Image.fromarray(pixels).save(folder / "transparent.png")
    Image.fromarray(pixels[..., 0].astype(np.uint16) * 257).save(folder / "deep.png")
    color.quantize(4).save(folder / "palette.png")
    color.save(folder / "profile.png", icc_profile=ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())


def _mask_seeds(folder: Path) -> None:
    labels = np.random.default_rng(0).integers(0, 3, (5, 7), dtype=np.uint8)
    Image.fromarray(labels).save(folder / "labels.png")
    Image.fromarray(255 * (labels > 0).astype(np.uint8)).save(folder / "white.png")
    Image.fromarray(labels.astype(np.uint16)).save(folder / "deep.png")


def _normals(path: Path) -> None:
    def no_photograph() -> torch.Tensor:
        raise FileNotFoundError

    read = normals_reader(path, camera_of())
    estimated_normals(View("a.png", camera_of(), path.parent / "a.png", no_photograph, read_normals=read))


READERS: dict[str, Reader] = {
    "ply": Reader("a.ply", _splats, _ply_seeds),
    "compressed": Reader("a.ply", _splats, _compressed_seeds),
    "spz": Reader("a.spz", _splats, _spz_seeds),
    "glb": Reader("a.glb", _splats, lambda folder: write_glb(folder / "a.glb", gaussians_of(4))),
    "splat": Reader("a.splat", _splats, _splat_seeds),
    "planes": Reader("planes.json", read_planes, lambda folder: write_planes(folder / "a.json", planes_of())),
    "cameras": Reader(
        "cameras.json", read_cameras, lambda folder: write_cameras(folder / "a.json", [("a.png", camera_of())])
    ),
    "exposures": Reader(
        "exposures.json",
        lambda path: read_corrections(path, Exposures),
        lambda folder: write_corrections(folder / "a.json", Exposures.neutral(("a.png",))),
    ),
    "environment": Reader(
        "environment.safetensors",
        read_environment,
        lambda folder: write_environment(folder / "a.safetensors", Environment(torch.zeros(6, 2, 2, 3))),
    ),
    "scene": Reader("scene.json", lambda path: read_scene(path.parent), _scene_seeds),
    "transforms": Reader("transforms.json", _transforms, _transforms_seeds),
    "colmap": Reader("model.bin", _colmap, _colmap_seeds),
    "colmap text": Reader("model.txt", _colmap_text, _text_seeds),
    "features": Reader("features.db", _database, _database_seeds, longest=200_000),
    "checkpoint": Reader("checkpoint.safetensors", load_checkpoint, _checkpoint_seeds, longest=16_384),
    "recipe": Reader("recipe.json", lambda path: RunDirectory(path.parent).recipe(), _recipe_seeds, longest=16_384),
    "settings": Reader("settings.json", lambda path: RunDirectory(path.parent).settings(), _settings_seeds),
    "log": Reader("log.jsonl", lambda path: lines_until(path, 10), _log_seeds),
    "annotations": Reader(ANNOTATIONS, lambda path: read_document(path.parent), _annotations_seeds),
    "photograph": Reader("a.png", read_colors, _picture_seeds, most_mib=LARGEST_PICTURE_MIB),
    "mask": Reader("a.png", read_mask, _mask_seeds, most_mib=LARGEST_PICTURE_MIB),
    "panorama": Reader(
        "a.exr", read_equirect, lambda folder: write_equirect(folder / "a.exr", torch.rand(4, 8, 3)), most_mib=2048
    ),
    "normals": Reader("a.npy", _normals, lambda folder: np.save(folder / "a.npy", np.ones((2, 3, 3), np.float32))),
}
