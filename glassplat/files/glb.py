"""Gaussians as binary glTF with KHR_gaussian_splatting, the extension that Khronos ratified in 2026.

Splats are a primitive of points with attributes: rotation (`xyzw`), scale (not logarithmic), opacity (a share), and the
coefficients of the harmonics, one attribute each. A glTF has x to the left and y up where a PLY has x to the right and
y down; both directions of the way turn it. Channels, as the intensity with which a Gaussian is mirrored, are attributes
of our own, which other programs leave alone.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from glassplat.files.atomic import atomic_write
from glassplat.files.fields import Choice, Field, Optional, checked
from glassplat.files.glb_container import NODE, PRIMITIVE, SCENE, GltfReader, GltfWriter
from glassplat.files.glb_placement import Placement, placed, placement_of
from glassplat.files.ply import CHANNEL_PREFIXES, is_channel
from glassplat.kernels.maths.color import linear_from_srgb
from glassplat.scene.activations import SH_ZERO
from glassplat.scene.gaussians import DISC_SCALES, Gaussians

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0
ROTATION, SCALE, OPACITY = (f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))
CHANNEL = "_GLASSPLAT_"
"""glTF leaves names that begin with an underscore to applications."""
SPLATS: dict[str, Field] = {
    "kernel": Choice(("ellipse",)),
    "colorSpace": Optional(Choice(("srgb_rec709_display",)), "srgb_rec709_display"),
    "projection": Optional(Choice(("perspective",)), "perspective"),
}
"""What the renderers here can draw; how a viewer sorts is its own affair."""
HIGHEST_DEGREE = 3
TURN = (-1.0, -1.0, 1.0)
TURNED_HARMONICS = (1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1)
"""How each harmonic changes its sign when x and y do."""
LEAST_SHARE, LEAST_SCALE = 1e-7, 1e-12
PLAIN_COUNT, BYTES_PER_GAUSSIAN = 2**20, 8
"""A file of B bytes may show B / 8 Gaussians, or a million: real ones take forty bytes, bombs show one often."""


def write_glb(path: Path | str, gaussians: Gaussians) -> None:
    """Writes shapes, opacities, colours and channels as GLB, atomically.

    A viewer that does not know the extension shows the centres as coloured points.

    Args:
        path: the file.
        gaussians: at least one, with colours, in the capture's frame; discs get a third scale of zero.

    Raises:
        ValueError: no Gaussians, no colours, a channel whose name PLY could not hold or that has capital letters, or a
            value that is not finite.
    """
    if not len(gaussians) or gaussians.max_sh_degree < 0:
        raise ValueError("no Gaussians, or none with colours, cannot be written as GLB; expected f_dc_0 to f_dc_2")
    unreadable = [name for name in gaussians.channels if name != name.lower() or not is_channel(name)]
    if unreadable:
        raise ValueError(
            f"cannot store channels {unreadable} as GLB: expected names in small letters that begin with one of "
            f"{CHANNEL_PREFIXES}"
        )
    broken = [name for name, tensor in gaussians.tensors().items() if not bool(tensor.isfinite().all())]
    if broken:
        raise ValueError(f"Gaussians whose {', '.join(broken)} are not all finite cannot be written as GLB")
    with atomic_write(path) as temporary:
        temporary.write_bytes(_glb_bytes(gaussians))


def read_glb(path: Path | str) -> Gaussians:
    """Reads the splats of a GLB, all of them as one set, in the frame of a PLY.

    Memory stays in proportion to the size of the file, whatever it says.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another kind of file, no splats in it, damaged, cut off, or stored in a way that is not read: in
            other files, sparse, compressed, or placed with a skewed or mirrored transform.
    """
    file = GltfReader(Path(path))
    found: list[Gaussians] = []
    shown = 0
    for mesh, placement in _placed_meshes(file):
        for index, primitive in enumerate(_splat_primitives(file, mesh)):
            shown += file.count(primitive.get("POSITION", 0))
            if shown > max(PLAIN_COUNT, file.size / BYTES_PER_GAUSSIAN):
                raise ValueError(
                    f"{path} shows {shown} Gaussians out of {file.size} bytes; no scene does: it is damaged"
                )
            where = f"primitive {index} of mesh {mesh} in {path}"
            found.append(placed(_read_primitive(file, primitive, where), placement))
    if not found:
        raise ValueError(f"{path} shows no splats: expected a primitive of points with {EXTENSION} in its scene")
    most = max(part.sh.shape[1] for part in found)
    are_discs = all(part.are_discs for part in found)
    shared = functools.reduce(set.intersection, (set(part.channels) for part in found))
    alike = (_alike(part, most, are_discs=are_discs) for part in found)
    whole = functools.reduce(
        Gaussians.joined,
        (replace(part, channels={name: part.channels[name] for name in sorted(shared)}) for part in alike),
    )
    return _turned(replace(whole, active_sh_degree=round(most**0.5) - 1))


def _glb_bytes(gaussians: Gaussians) -> bytes:
    turned = _turned(replace(gaussians, sh=gaussians.sh[:, : (gaussians.active_sh_degree + 1) ** 2]))
    quats = torch.nn.functional.normalize(turned.quats, dim=1)
    quats = torch.where(quats.norm(dim=1, keepdim=True) > 0, quats, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
    opacities = torch.sigmoid(turned.logit_opacities)
    diffuse = linear_from_srgb((turned.sh[:, 0] * SH_ZERO + 0.5).clamp(0, 1))
    writer = GltfWriter()
    attributes = {
        "POSITION": writer.add(_numpy(turned.means), bounded=True),
        "COLOR_0": writer.add(_numpy(torch.cat([diffuse, opacities[:, None]], dim=1))),
        ROTATION: writer.add(_numpy(quats.roll(-1, dims=1))),
        SCALE: writer.add(_numpy(turned.deviations)),
        OPACITY: writer.add(_numpy(opacities)),
    }
    for index, name in enumerate(_harmonic_names(turned.sh.shape[1])):
        attributes[name] = writer.add(_numpy(turned.sh[:, index]))
    for name, values in turned.channels.items():
        attributes[CHANNEL + name.upper()] = writer.add(_numpy(values))
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
    primitive = {"mode": POINTS, "attributes": attributes, "extensions": {EXTENSION: splats}}
    return writer.file(
        {
            "asset": {"version": "2.0", "generator": "glassplat"},
            "extensionsUsed": [EXTENSION],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
        }
    )


def _placed_meshes(file: GltfReader) -> list[tuple[int, Placement]]:
    """The meshes that the scene shows, each with where; a file without scenes shows all its nodes."""
    scenes = file.listed("scenes")
    chosen = file.document.get("scene", 0)
    if scenes:
        index = chosen if isinstance(chosen, int) and 0 <= chosen < len(scenes) else len(scenes)
        pending = [(node, Placement()) for node in file.entry("scenes", index, SCENE)["nodes"]]
    else:
        pending = [(node, Placement()) for node in range(len(file.listed("nodes")))]
    found: list[tuple[int, Placement]] = []
    seen: set[int] = set()
    while pending:
        number, outer = pending.pop()
        if number in seen:
            raise ValueError(f"node {number} of {file.path} hangs below two others; expected a tree: it is damaged")
        seen.add(number)
        node = file.entry("nodes", number, NODE)
        placement = placement_of(node, outer, f"node {number} of {file.path}")
        if node["mesh"] is not None:
            found.append((node["mesh"], placement))
        if scenes:
            pending += [(child, placement) for child in node["children"]]
    return found


def _splat_primitives(file: GltfReader, mesh: int) -> list[dict[str, int]]:
    """The attributes of those primitives of a mesh that are splats."""
    where = f"mesh {mesh} of {file.path}"
    primitives = file.raw("meshes", mesh).get("primitives")
    if not isinstance(primitives, list):
        raise ValueError(f"{where} has no list of primitives; the file is damaged")
    found = []
    for index, entry in enumerate(primitives):
        primitive = checked(entry, PRIMITIVE, f"primitive {index} of {where}")
        extensions = entry.get("extensions")
        if not isinstance(extensions, dict) or EXTENSION not in extensions:
            continue
        splats = extensions[EXTENSION]
        checked(splats, SPLATS, f"{EXTENSION} of primitive {index} of {where}")
        packed = splats.get("extensions") if isinstance(splats, dict) else None
        if packed or primitive["mode"] != POINTS:
            raise ValueError(f"the splats of {where} are packed by {packed or 'no points'}; expected them as they are")
        found.append(primitive["attributes"])
    return found


def _read_primitive(file: GltfReader, attributes: dict[str, int], where: str) -> Gaussians:
    """The splats of a primitive, in the frame of glTF."""
    degree = _stored_degree(attributes, where)
    names = _harmonic_names((degree + 1) ** 2)
    channels = {name.removeprefix(CHANNEL).lower(): name for name in attributes if name.startswith(CHANNEL)}
    channels = {channel: name for channel, name in channels.items() if is_channel(channel)}
    missing = [name for name in ("POSITION", ROTATION, SCALE, OPACITY, *names) if name not in attributes]
    if missing:
        raise ValueError(f"{where} lacks {', '.join(missing)}; expected all that {EXTENSION} asks for")
    counts = {
        name: file.count(attributes[name])
        for name in ("POSITION", ROTATION, SCALE, OPACITY, *names, *channels.values())
    }
    if len(set(counts.values())) > 1:
        raise ValueError(f"the attributes of {where} have {sorted(set(counts.values()))} rows; expected one number")
    scales = _tensor(file.array(attributes[SCALE], 3))
    if bool((scales < 0).any()):
        raise ValueError(
            f"{where} has negative scales, as drafts of {EXTENSION} stored logarithms; expected the ratified form: "
            "export it with a newer version of the program that wrote it"
        )
    are_discs = bool((scales[:, 2] == 0).all()) and bool((scales[:, :DISC_SCALES] > 0).any())
    shares = _tensor(file.array(attributes[OPACITY], 1))[:, 0]
    return Gaussians(
        means=_tensor(file.array(attributes["POSITION"], 3)),
        quats=_tensor(file.array(attributes[ROTATION], 4)).roll(1, dims=1),
        log_scales=scales[:, : DISC_SCALES if are_discs else 3].clamp(min=LEAST_SCALE).log(),
        logit_opacities=torch.logit(shares.double().clamp(LEAST_SHARE, 1 - LEAST_SHARE)).float(),
        sh=torch.stack([_tensor(file.array(attributes[name], 3)) for name in names], dim=1),
        channels={name: _tensor(file.array(attributes[stored], 1))[:, 0] for name, stored in channels.items()},
        active_sh_degree=degree,
    )


def _stored_degree(attributes: dict[str, int], where: str) -> int:
    """The highest degree of harmonics of which there is any coefficient."""
    prefix = f"{EXTENSION}:SH_DEGREE_"
    degrees = {name.removeprefix(prefix).partition("_")[0] for name in attributes if name.startswith(prefix)}
    if not degrees <= {str(degree) for degree in range(HIGHEST_DEGREE + 1)}:
        raise ValueError(f"{where} has harmonics of the degrees {sorted(degrees)}; expected 0 to {HIGHEST_DEGREE}")
    return max(map(int, degrees), default=0)


def _harmonic_names(count: int) -> list[str]:
    """The attributes of that many coefficients: 1, 4, 9 or 16."""
    degrees = range(round(count**0.5))
    return [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for degree in degrees for n in range(2 * degree + 1)]


def _alike(part: Gaussians, coefficients: int, *, are_discs: bool) -> Gaussians:
    """A set with so many coefficients, and the shape that all sets have."""
    sh = torch.nn.functional.pad(part.sh, (0, 0, 0, coefficients - part.sh.shape[1]))
    log_scales = part.log_scales
    if part.are_discs and not are_discs:
        log_scales = torch.nn.functional.pad(log_scales, (0, 1), value=float(np.log(LEAST_SCALE)))
    return replace(part, sh=sh, log_scales=log_scales)


def _turned(gaussians: Gaussians) -> Gaussians:
    """Half around the z axis: to the frame of glTF, and back."""
    flip = gaussians.means.new_tensor(TURN)
    signs = gaussians.sh.new_tensor(TURNED_HARMONICS[: gaussians.sh.shape[1]])[:, None]
    quats = gaussians.quats * torch.cat([flip.new_ones(1), flip])
    return gaussians.with_tensors({"means": gaussians.means * flip, "quats": quats, "sh": gaussians.sh * signs})


def _numpy(tensor: Tensor) -> Any:
    return tensor.detach().to("cpu", torch.float32).numpy()


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
