"""Scenes as folders, and splat files of any format; SOG and KSPLAT require gaussforge, an extra."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from glassplat.files import records, sidecars
from glassplat.files.glb import MAGIC
from glassplat.files.ply import read_gaussians, write_gaussians
from glassplat.files.spz import GZIP, three_log_scales
from glassplat.files.writing import (
    GAUSSFORGE_SUFFIXES,
    SCENE_FILE,
    SPLAT_READERS,
    SPLAT_SUFFIXES,
    import_function,
    write_bytes,
    write_text,
)
from glassplat.scene import SH_ZERO
from glassplat.scene.corrections import Direction, Exposures, PoseCorrections
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene

PRIMARY, GLASS, PLANES = "point_cloud.ply", "glass.ply", "planes.json"
ENVIRONMENT, SURROUNDINGS, EXPOSURES = "environment.safetensors", "surroundings.ply", "exposures.json"
PHOTOGRAPHER, POSES = "photographer.ply", "poses.json"
FILES = (PRIMARY, GLASS, PLANES, ENVIRONMENT, SURROUNDINGS, EXPOSURES, PHOTOGRAPHER, POSES)
LARGEST_COLOR, LARGEST_LOG = 1e6, 40.0
"""Largest colour or other channel, and largest logarithm; the square of its exponential fits float32."""
EXTENT = records.Number(above=1 / records.LARGEST_COORDINATE, most=4 * records.LARGEST_COORDINATE)
"""World units; squares of smaller values may underflow float32."""
SH_DEGREE = records.Integer(0, 3)
DIRECTION = records.Nullable(records.ListOf(records.Number(-1.001, 1.001), 3))
UNIT_TOLERANCE = 1e-3
"""Largest deviation of a direction's length from one."""
HEADER: dict[str, records.Field] = {
    "extent": EXTENT,
    "active_sh_degree": SH_DEGREE,
    "surroundings_sh_degree": records.Optional(SH_DEGREE),
    "photographer_sh_degree": records.Optional(SH_DEGREE),
    "up": records.Optional(DIRECTION),
    "files": records.Optional(records.ListOf(records.Choice(FILES))),
}
"""`files` lists the parts of the scene, so that a lost file is detected and one of an earlier scene is ignored; folders
of earlier versions lack it."""


def write_scene(folder: Path, scene: Scene) -> None:
    """Writes a scene; `read_scene` returns it exactly.

    `point_cloud.ply` holds the primary Gaussians, which any splat viewer shows without reflections. `glass.ply` and
    `planes.json` are for viewers that support panes. `environment.safetensors` holds the raw texels of the
    environment's cube map, `surroundings.ply` the Gaussians seen in reflections. `exposures.json` holds the exposures
    of the photographs, `poses.json` the corrections of their camera poses. `photographer.ply` holds the reflection of
    the photographer, in a frame that moves with the camera. Parts that the scene lacks are not written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [PRIMARY]
    write_gaussians(folder / PRIMARY, scene.primary)
    if len(scene.planes):
        write_gaussians(folder / GLASS, scene.glass)
        sidecars.write_planes(folder / PLANES, scene.planes)
        files += [GLASS, PLANES]
    if not scene.environment.is_empty:
        sidecars.write_environment(folder / ENVIRONMENT, scene.environment)
        files += [ENVIRONMENT]
    header = {"extent": scene.extent, "active_sh_degree": scene.primary.active_sh_degree, "files": files}
    for name, gaussians in ((SURROUNDINGS, scene.surroundings), (PHOTOGRAPHER, scene.photographer)):
        if len(gaussians):
            write_gaussians(folder / name, gaussians)
            header[f"{Path(name).stem}_sh_degree"] = gaussians.active_sh_degree
            files += [name]
    if len(scene.photographer):
        header["up"] = scene.up
    for name, corrections in ((EXPOSURES, scene.exposures), (POSES, scene.poses)):
        if len(corrections):
            sidecars.write_corrections(folder / name, corrections)
            files += [name]
    write_text(folder / SCENE_FILE, json.dumps(header, indent=2) + "\n")


def read_scene(folder: Path) -> Scene:
    """Reads a scene that `write_scene` wrote."""
    header = records.check_fields(records.read_json(folder / SCENE_FILE), HEADER, str(folder / SCENE_FILE))
    for name in header["files"] or ():
        if not os.path.isfile(folder / name):
            raise FileNotFoundError(f"no {name} in {folder}; {SCENE_FILE} says that the scene has one: export it again")
    files = FILES if header["files"] is None else header["files"]
    listed = [name for name in files if (folder / name).is_file()]
    scene = Scene(_colored(folder, PRIMARY, header["active_sh_degree"]), header["extent"])
    if PLANES in listed:
        scene = replace(scene, glass=_glass(folder / GLASS), planes=sidecars.read_planes(folder / PLANES))
    if ENVIRONMENT in listed:
        scene = replace(scene, environment=sidecars.read_environment(folder / ENVIRONMENT))
    if SURROUNDINGS in listed:
        scene = replace(scene, surroundings=_colored(folder, SURROUNDINGS, header["surroundings_sh_degree"]))
    if PHOTOGRAPHER in listed:
        photographer = _ellipsoids(
            _colored(folder, PHOTOGRAPHER, header["photographer_sh_degree"]), folder / PHOTOGRAPHER
        )
        scene = replace(scene, photographer=photographer, up=direction(header["up"], str(folder / SCENE_FILE)))
    if EXPOSURES in listed:
        scene = replace(scene, exposures=sidecars.read_corrections(folder / EXPOSURES, Exposures))
    if POSES in listed:
        scene = replace(scene, poses=sidecars.read_corrections(folder / POSES, PoseCorrections))
    return scene


def direction(up: Sequence[float] | None, where: str) -> Direction | None:
    """The unit direction in a header, if any."""
    if up is None:
        return None
    x, y, z = up
    if abs(math.hypot(x, y, z) - 1) > UNIT_TOLERANCE:
        raise ValueError(f"up in {where} has length {math.hypot(x, y, z):g}; expected a unit direction")
    return (x, y, z)


def _colored(folder: Path, name: str, active_sh_degree: int | None) -> Gaussians:
    """Gaussians with the SH degree from the scene's header, or else the highest degree stored."""
    gaussians = _read_drawable(folder / name)
    if active_sh_degree is None:
        return gaussians
    try:
        return replace(gaussians, active_sh_degree=active_sh_degree)
    except ValueError as error:
        raise ValueError(f"{folder / SCENE_FILE} and {folder / name} do not belong together: {error}") from error


def _glass(path: Path) -> Gaussians:
    """Glass with its marks, which determine where it reflects."""
    glass = _ellipsoids(_read_drawable(path), path)
    if "logit_mark" not in glass.channels:
        raise ValueError(f"{path} has no property logit_mark; expected glass as `planar` exports it")
    return glass


def _ellipsoids(gaussians: Gaussians, path: Path) -> Gaussians:
    """Checks that Gaussians have three scales, as compositing them with others requires."""
    if gaussians.are_discs:
        raise ValueError(f"{path} has two scales, scale_0 and scale_1; expected three, as `planar` exports it")
    return gaussians


def _read_drawable(path: Path) -> Gaussians:
    """Reads Gaussians and refuses colours and channels that make images non-finite; renderers skip undrawable ones."""
    gaussians = read_gaussians(path)
    bounds = {"sh": LARGEST_COLOR} | {
        name: LARGEST_LOG if name.startswith("log_") else LARGEST_COLOR for name in gaussians.channels
    }
    for name, most in bounds.items():
        values = gaussians.tensors()[name]
        broken = ~(values.abs() <= most)  # Also true for NaN.
        if bool(broken.any()):
            raise ValueError(f"{path} holds the value {values[broken][0]:g} of {name}; expected at most {most:g}")
    return gaussians


SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])
LEAST_SCALE = 1e-12
"""Minimum scale, for a finite logarithm."""
FIRST_BYTES = {b"ply": "ply", GZIP: "spz", b"NGSP": "spz", MAGIC: "glb"}
"""Formats that are recognised by their contents, whatever the suffix."""


def read_splats(path: Path | str) -> Gaussians:
    """Reads the Gaussians of a file in the frame of a PLY (y down, z forward), without filtering.

    The format is detected by the first bytes where these are known, else by the suffix.
    """
    path = Path(path)
    with records.wrap_read_errors(path), path.open("rb") as stream:
        head = stream.read(4)
    named = path.suffix.lower().removeprefix(".")
    by_name = None if named in FIRST_BYTES.values() else named
    kind = next((kind for first, kind in FIRST_BYTES.items() if head.startswith(first)), by_name)
    if kind not in SPLAT_READERS:
        found = f"begins with the bytes {head!r}" if head else "is empty"
        raise ValueError(
            f"{path} is not a readable splat file, because it {found}; expected one of {', '.join(SPLAT_SUFFIXES)}: "
            "export or copy it again"
        )
    gaussians: Gaussians = import_function(SPLAT_READERS[kind])(path)
    return gaussians


def select_drawable(gaussians: Gaussians, path: Path | str) -> tuple[Gaussians, int]:
    """The drawable Gaussians, and the number of others: non-finite or extreme values, or zero quaternions."""
    bounds = {
        "means": records.LARGEST_COORDINATE,
        "log_scales": LARGEST_LOG,
        "sh": LARGEST_COLOR,
        "quats": LARGEST_COLOR,
    }
    good = ~torch.isnan(gaussians.logit_opacities) & (gaussians.quats.square().sum(1) > 0)
    for name, most in bounds.items():
        values = gaussians.tensors()[name].flatten(1)
        # Scales may be arbitrarily small.
        good &= ((values if name == "log_scales" else values.abs()) <= most).all(dim=1) & ~values.isnan().any(dim=1)
    for name, values in gaussians.channels.items():
        good &= values.abs() <= (LARGEST_LOG if name.startswith("log_") else LARGEST_COLOR)
    lost = len(gaussians) - int(good.sum())
    if lost and lost == len(gaussians):
        raise ValueError(
            f"none of the {lost} Gaussians in {path} can be drawn: they contain NaN or values that are too large"
        )
    kept = gaussians.select(good) if lost else gaussians
    clamped = {
        "logit_opacities": kept.logit_opacities.clamp(-LARGEST_LOG, LARGEST_LOG),
        "log_scales": kept.log_scales.clamp(min=-LARGEST_LOG),
    }
    return kept.with_tensors(clamped), lost


def read_dot_splat(path: Path) -> Gaussians:
    """Reads a .splat: 32 bytes per Gaussian, with activated colours and opacities, and linear scales."""
    size = os.stat(path).st_size
    if size == 0 or size % SPLAT_ROW.itemsize:
        raise ValueError(
            f"{path} has {size} bytes; expected {SPLAT_ROW.itemsize} per Gaussian: it is cut off, or not a .splat"
        )
    with records.wrap_read_errors(path):
        rows = np.fromfile(path, dtype=SPLAT_ROW)
    shares = torch.from_numpy(rows["color"].astype(np.float32) / 255)
    scales = torch.from_numpy(rows["scale"].astype(np.float32))
    return Gaussians(
        means=torch.from_numpy(rows["mean"].astype(np.float32)),
        quats=torch.from_numpy((rows["quat"].astype(np.float32) - 128) / 128),
        log_scales=scales.clamp(min=LEAST_SCALE).log(),
        logit_opacities=torch.logit(shares[:, 3].clamp(0.5 / 255, 1 - 0.5 / 255)),
        sh=((shares[:, None, :3] - 0.5) / SH_ZERO).contiguous(),
    )


def read_with_gaussforge(path: Path) -> Gaussians:
    """Reads a .sog (PlayCanvas) or .ksplat (GaussianSplats3D), both lossy, in the frame of a PLY."""
    forge, kind = _gaussforge(path), path.suffix.lower()[1:]
    with records.wrap_read_errors(path):
        data = path.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "scene.ply"
        plain.write_bytes(_convert(forge, data, kind, "ply", path))
        try:
            return read_gaussians(plain)
        except ValueError as error:
            raise ValueError(str(error).replace(str(plain), str(path))) from error


def write_with_gaussforge(path: Path, gaussians: Gaussians) -> None:
    """Writes a .sog or .ksplat; discs get the smallest third scale of SPZ.

    Raises:
        ValueError: gaussforge is not installed, or cannot write these Gaussians; or there are none.
        OSError: the file cannot be written; an older one is unchanged.
    """
    forge = _gaussforge(path)
    if not len(gaussians):
        raise ValueError(f"there are no Gaussians to write as {path}; expected one at least")
    # SOG omits the largest component of a quaternion, which follows from unit length.
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
    gaussians = replace(gaussians, quats=quats, log_scales=three_log_scales(gaussians))
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "scene.ply"
        write_gaussians(plain, gaussians)
        data = _convert(forge, plain.read_bytes(), "ply", path.suffix.lower()[1:], path)
    write_bytes(path, data)


def _gaussforge(path: Path) -> Any:
    try:
        from gaussforge import GaussForge
    except ImportError as error:
        raise ValueError(
            f"{path}: {' and '.join(GAUSSFORGE_SUFFIXES)} need gaussforge ({error}); pip install 'glassplat[formats]'"
        ) from error
    return GaussForge()


def _convert(forge: Any, data: bytes, source: str, target: str, path: Path) -> bytes:
    result = forge.convert(data, source, target)
    if "data" not in result:
        raise ValueError(f"gaussforge cannot convert {path} from {source} to {target}: {result.get('error')}")
    converted: bytes = result["data"]
    return converted
