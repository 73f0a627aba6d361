"""Gaussians as binary glTF with KHR_gaussian_splatting, the extension that Khronos ratified in 2026.

Splats are a primitive of points with attributes: rotation (`xyzw`), scale (linear), opacity (0 to 1), and the SH
coefficients, one attribute each. A glTF has x to the left and y up where a PLY has x to the right and y down; reading
and writing rotate the scene accordingly. Channels, such as a Gaussian's reflection intensity, are application
attributes, which other programs ignore.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
import struct
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.files import records
from glassplat.files.ply import CHANNEL_PREFIXES, as_numpy, as_tensor, is_channel
from glassplat.files.writing import write_bytes
from glassplat.kernels.maths.images import linear_from_srgb
from glassplat.kernels.project.reference import sh_basis
from glassplat.options import short_repr
from glassplat.scene import SH_ZERO
from glassplat.scene.camera import quat_from_rotation, quat_product, rotation_from_quat
from glassplat.scene.gaussians import DISC_SCALES, Gaussians, rotate_half_turn

NUM_DIRECTIONS = 64
"""Number of directions that determine the rotation of up to 16 SH coefficients."""


def rotate_sh(sh: Tensor, rotation: Tensor) -> Tensor:
    """Rotated SH coefficients: the new colour along d is the old colour along R^T d.

    Rotations do not mix degrees, so a few directions determine the map between the coefficients exactly.

    Args:
        sh: [N, K, 3], K in {0, 1, 4, 9, 16}.
        rotation: [3, 3] orthogonal R; may be a reflection.
    """
    count = sh.shape[1]
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(NUM_DIRECTIONS, 3, generator=generator, dtype=torch.float64))
    before, after = (sh_basis(rays)[:, :count] for rays in (directions, directions @ rotation.to(directions)))
    sh_rotation = torch.linalg.lstsq(before, after).solution
    return torch.einsum("jk,nkc->njc", sh_rotation.to(sh), sh)


MAGIC, VERSION = b"glTF", 2
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
JSON_CHUNK, BINARY_CHUNK, FLOAT, ARRAY_BUFFER = 0x4E4F534A, 0x004E4942, 5126, 34962
"""Codes of glTF for the types of chunks, for float32, and for the data of vertices."""
COMPONENTS: dict[int, str] = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MOST_BYTES = 2**32 - 1
"""Largest file: the header stores its size in 32 bits."""

INDEX = records.Integer(0, 2**31)
ACCESSOR: dict[str, records.Field] = {
    "bufferView": INDEX,
    "byteOffset": records.Optional(records.Integer(0, MOST_BYTES), 0),
    "componentType": records.Choice(tuple(COMPONENTS)),
    "normalized": records.Optional(records.Boolean(), False),
    "count": records.Integer(1, MOST_BYTES),
    "type": records.Choice(tuple(WIDTHS)),
}
VIEW: dict[str, records.Field] = {
    "buffer": records.Integer(0, 0),
    "byteOffset": records.Optional(records.Integer(0, MOST_BYTES), 0),
    "byteLength": records.Integer(1, MOST_BYTES),
    "byteStride": records.Optional(records.Integer(4, 252)),
}
NODE: dict[str, records.Field] = {
    "mesh": records.Optional(INDEX),
    "children": records.Optional(records.ListOf(INDEX), ()),
    "matrix": records.Optional(records.ListOf(records.Number(-1e12, 1e12), 16)),
    "translation": records.Optional(records.ListOf(records.Number(-1e12, 1e12), 3), (0.0, 0.0, 0.0)),
    "rotation": records.Optional(records.ListOf(records.Number(-1.01, 1.01), 4), (0.0, 0.0, 0.0, 1.0)),
    "scale": records.Optional(records.ListOf(records.Number(-1e12, 1e12), 3), (1.0, 1.0, 1.0)),
}
PRIMITIVE: dict[str, records.Field] = {
    "attributes": records.DictOf(INDEX),
    "mode": records.Optional(records.Integer(0, 6), 4),
}
SCENE: dict[str, records.Field] = {"nodes": records.Optional(records.ListOf(INDEX), ())}
ASSET: dict[str, records.Field] = {"version": records.Text()}


class GltfReader:
    """A GLB file with an embedded buffer; entries are validated when they are used."""

    def __init__(self, path: Path) -> None:
        """Reads the file."""
        with records.wrap_read_errors(path):
            data = path.read_bytes()
        self.path, self.size = path, len(data)
        text, self._buffer = _read_chunks(data, path)
        document = records.parse_json(text, str(path))
        if not isinstance(document, dict):
            raise ValueError(f"{path} holds {short_repr(document)}; expected a glTF document")
        self.document: dict[str, Any] = document
        version = records.check_fields(document.get("asset"), ASSET, f"asset of {path}")["version"]
        if version.partition(".")[0] != str(VERSION):
            raise ValueError(f"{path} is glTF of version {version}; expected 2.0: export it again")

    def list_of(self, kind: str) -> list[Any]:
        """The list of that name in the document; empty if there is none."""
        found = self.document.get(kind, [])
        if not isinstance(found, list):
            raise ValueError(f"{kind} of {self.path} is {short_repr(found)}; expected a list")
        return found

    def entry(self, kind: str, index: int, fields: Mapping[str, records.Field]) -> dict[str, Any]:
        """The checked fields of one entry of a list."""
        return records.check_fields(self.raw(kind, index), fields, f"entry {index} of {kind} in {self.path}")

    def raw(self, kind: str, index: int) -> dict[str, Any]:
        """One entry of a list, unchecked, including its extensions."""
        found = self.list_of(kind)
        if index >= len(found) or not isinstance(found[index], dict):
            raise ValueError(f"{self.path} refers to entry {index} of {kind}, which is not there; it is damaged")
        entry: dict[str, Any] = found[index]
        return entry

    def count(self, index: int) -> int:
        """Number of rows of an accessor."""
        return int(self.entry("accessors", index, ACCESSOR)["count"])

    def array(self, index: int, width: int) -> NDArray[np.float32]:
        """The rows [N, width] of an accessor as float32, dequantised if they are normalised integers."""
        accessor = self.entry("accessors", index, ACCESSOR)
        view = self.entry("bufferViews", accessor["bufferView"], VIEW)
        if WIDTHS[accessor["type"]] != width or "sparse" in self.raw("accessors", index):
            raise ValueError(
                f"accessor {index} of {self.path} holds {accessor['type']}; expected {width} numbers a row, not sparse"
            )
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        stride = view["byteStride"] or width * kind.itemsize
        start, end = view["byteOffset"], view["byteOffset"] + view["byteLength"]
        first = start + accessor["byteOffset"]
        last = first + (accessor["count"] - 1) * stride + width * kind.itemsize
        if last > end or end > len(self._buffer) or stride < width * kind.itemsize:
            raise ValueError(
                f"accessor {index} of {self.path} reaches to byte {last} of a view that ends at {end}, in a buffer of "
                f"{len(self._buffer)}: the file is cut off or damaged; export it again"
            )
        rows = np.ndarray((accessor["count"], width), kind, self._buffer, offset=first, strides=(stride, kind.itemsize))
        return _dequantise(rows, normalized=accessor["normalized"])


def _read_chunks(data: bytes, path: Path) -> tuple[str, bytes]:
    """The document's text, and the buffer, which may be empty."""
    if len(data) < HEADER.size + CHUNK.size or data[:4] != MAGIC:
        raise ValueError(f"{path} is not a GLB: expected glTF at its beginning; give a .glb file")
    _, version, announced = HEADER.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"{path} is a GLB of version {version}; expected 2: export it again")
    size, kind = CHUNK.unpack_from(data, HEADER.size)
    start = HEADER.size + CHUNK.size
    if announced > len(data) or kind != JSON_CHUNK or not 0 < size <= min(announced - start, records.LARGEST_TEXT):
        raise ValueError(
            f"{path} announces {announced} bytes, {size} of them its document, but has {len(data)}; it is cut off or "
            "damaged"
        )
    try:
        text = data[start : start + size].decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"the document of {path} is not UTF-8 text ({error.reason}); it is damaged") from error
    at = start + size
    if at + CHUNK.size > announced:
        return text, b""
    size, kind = CHUNK.unpack_from(data, at)
    if kind != BINARY_CHUNK or at + CHUNK.size + size > len(data):
        raise ValueError(f"the buffer of {path} has {size} bytes, which are not all there; it is cut off or damaged")
    return text, data[at + CHUNK.size : at + CHUNK.size + size]


def _dequantise(rows: NDArray, *, normalized: bool) -> NDArray[np.float32]:
    """Normalised integers divided by their maximum and clamped at -1 (glTF 2.0, Section 3.11), or plain values."""
    values: NDArray[np.float32] = rows.astype(np.float32)
    if normalized and rows.dtype.kind in "iu":
        values = np.maximum(values / np.float32(np.iinfo(rows.dtype).max), np.float32(-1))
    return values


TOLERANCE, LEAST_NODE_SCALE, MOST_SCALE = 1e-4, 1e-9, 1e9
"""Largest deviation of a placement's axes from orthogonal ones of one length, and the range of its scale."""


def matrix_of(node: Mapping[str, Any]) -> Tensor:
    """[4, 4] float64 the transform of a node relative to its parent."""
    if node["matrix"] is not None:
        return torch.tensor(node["matrix"], dtype=torch.float64).reshape(4, 4).T
    own = torch.eye(4, dtype=torch.float64)
    x, y, z, w = node["rotation"]
    turn, scales, shift = (
        torch.tensor(part, dtype=torch.float64) for part in ((w, x, y, z), node["scale"], node["translation"])
    )
    # A quaternion of length 0 is invalid; it becomes a scale of 0, which `check_placement` refuses.
    own[:3, :3], own[:3, 3] = rotation_from_quat(turn) * scales * (math.hypot(x, y, z, w) > TOLERANCE), shift
    return own


def check_placement(placement: Tensor, where: str) -> None:
    """Raises ValueError unless a transform [4, 4] is a turn, a shift and one positive scale."""
    rotation, scale = _rotation_and_scale(placement)
    shear = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
    if (
        placement[3].tolist() != [0, 0, 0, 1]
        or not LEAST_NODE_SCALE <= scale <= MOST_SCALE
        or not shear < TOLERANCE
        or not float(torch.linalg.det(rotation)) > 0
    ):
        raise ValueError(
            f"{where}, together with the nodes above it, skews, mirrors or stretches splats; expected a turn, a shift "
            "and one scale: apply the transforms first"
        )


def _rotation_and_scale(placement: Tensor) -> tuple[Tensor, float]:
    scale = float(placement[:3, :3].norm()) / math.sqrt(3)
    return placement[:3, :3] / max(scale, LEAST_NODE_SCALE), scale


def place_gaussians(gaussians: Gaussians, placement: Tensor) -> Gaussians:
    """The Gaussians transformed by a placement, including their SH; the identity changes no bit."""
    if torch.equal(placement, torch.eye(4, dtype=torch.float64)):
        return gaussians
    rotation, scale = _rotation_and_scale(placement)
    means = gaussians.means.double() @ placement[:3, :3].T + placement[:3, 3]
    quats = quat_product(quat_from_rotation(rotation).expand(len(gaussians), 4), gaussians.quats.double())
    return replace(
        gaussians,
        means=means.float(),
        quats=quats.float(),
        log_scales=gaussians.log_scales + math.log(scale),
        sh=rotate_sh(gaussians.sh, rotation),
    )


EXTENSION = "KHR_gaussian_splatting"
POINTS, HIGHEST_DEGREE = 0, 3
"""Code of glTF for a primitive of points, and the highest SH degree of the extension."""
ROTATION, SCALE, OPACITY = (f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))
CHANNEL = "_GLASSPLAT_"
"""glTF leaves names that begin with an underscore to applications."""
SPLATS: dict[str, records.Field] = {
    "kernel": records.Choice(("ellipse",)),
    "colorSpace": records.Optional(records.Choice(("srgb_rec709_display",)), "srgb_rec709_display"),
    "projection": records.Optional(records.Choice(("perspective",)), "perspective"),
}
"""Properties that the renderers support; the sorting method is not checked."""
HALF_TURN_Z = (-1.0, -1.0, 1.0)
"""Signs of a half turn around z, which converts to the frame of glTF and back."""
LEAST_SHARE, LEAST_SCALE = 1e-7, 1e-12
"""Minimum opacity and scale, for finite raw values."""
PLAIN_COUNT, BYTES_PER_GAUSSIAN = 2**20, 8
"""A file of B bytes may show B / 8 Gaussians, or a million; real ones take forty bytes, bombs repeat one often."""
MOST_NODES, MOST_PARTS = 10_000, 2000
"""Maximum numbers of nodes and of splat sets shown; reading that many takes seconds."""


def write_glb(path: Path | str, gaussians: Gaussians) -> None:
    """Writes shapes, opacities, colours and channels as GLB, atomically.

    Viewers without the extension show the centres as coloured points.

    Args:
        path: the file.
        gaussians: at least one, with colours, in the capture's frame; discs get a third scale of zero.
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
    write_bytes(path, _glb_bytes(gaussians))


def read_glb(path: Path | str) -> Gaussians:
    """Reads the splats of a GLB, all of them as one set, in the frame of a PLY.

    Memory stays proportional to the file size, whatever the file declares.
    """
    file = GltfReader(Path(path))
    splats_of = functools.cache(functools.partial(_splat_primitives, file))
    every = (
        (primitive, f"primitive {index} of mesh {mesh} in {path}", node, placement)
        for mesh, node, placement in _placed_meshes(file)
        for index, primitive in enumerate(splats_of(mesh))
    )
    shown = list(itertools.islice(every, MOST_PARTS + 1))
    if len(shown) > MOST_PARTS:
        raise ValueError(f"{path} shows more than {MOST_PARTS} sets of splats; expected fewer: join them")
    count = sum(file.count(primitive.get("POSITION", 0)) for primitive, _, _, _ in shown)
    if count > max(PLAIN_COUNT, file.size / BYTES_PER_GAUSSIAN):
        raise ValueError(f"{path} shows {count} Gaussians out of {file.size} bytes; no scene does: it is damaged")
    found = []
    for primitive, where, node, placement in shown:
        check_placement(placement, f"node {node} of {path}")
        found.append(place_gaussians(_read_primitive(file, primitive, where), placement))
    if not found:
        raise ValueError(f"{path} shows no splats: expected a primitive of points with {EXTENSION} in its scene")
    most = max(part.sh.shape[1] for part in found)
    are_discs = all(part.are_discs for part in found)
    shared = functools.reduce(set.intersection, (set(part.channels) for part in found))
    padded = (_pad_gaussians(part, most, are_discs=are_discs) for part in found)
    whole = functools.reduce(
        Gaussians.concat,
        (replace(part, channels={name: part.channels[name] for name in sorted(shared)}) for part in padded),
    )
    return rotate_half_turn(replace(whole, active_sh_degree=round(most**0.5) - 1), HALF_TURN_Z)


def _glb_bytes(gaussians: Gaussians) -> bytes:
    num_bases = (gaussians.active_sh_degree + 1) ** 2
    rotated = rotate_half_turn(replace(gaussians, sh=gaussians.sh[:, :num_bases]), HALF_TURN_Z)
    quats = torch.nn.functional.normalize(rotated.quats, dim=1)
    quats = torch.where(quats.norm(dim=1, keepdim=True) > 0, quats, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
    opacities = torch.sigmoid(rotated.logit_opacities)
    diffuse = linear_from_srgb((rotated.sh[:, 0] * SH_ZERO + 0.5).clamp(0, 1))
    return _pack_document(
        {
            "POSITION": rotated.means,
            "COLOR_0": torch.cat([diffuse, opacities[:, None]], dim=1),
            ROTATION: quats.roll(-1, dims=1),
            SCALE: rotated.deviations,
            OPACITY: opacities,
            **dict(zip(_harmonic_names(rotated.sh.shape[1]), rotated.sh.unbind(1), strict=True)),
            **{CHANNEL + name.upper(): values for name, values in rotated.channels.items()},
        }
    )


def _pack_document(attributes: Mapping[str, Tensor]) -> bytes:
    """The GLB of one primitive with attributes [N] or [N, 2 to 4], the positions first."""
    arrays = [np.ascontiguousarray(as_numpy(values), dtype="<f4") for values in attributes.values()]
    *starts, total = itertools.accumulate((data.nbytes for data in arrays), initial=0)
    kinds = ["SCALAR" if data.ndim == 1 else f"VEC{data.shape[1]}" for data in arrays]
    accessors: list[dict[str, Any]] = [
        {"bufferView": index, "componentType": FLOAT, "count": len(data), "type": kind}
        for index, (data, kind) in enumerate(zip(arrays, kinds, strict=True))
    ]
    # Positions require the minimum and maximum of each column.
    accessors[0] |= {"min": arrays[0].min(axis=0).tolist(), "max": arrays[0].max(axis=0).tolist()}
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
    names = {name: index for index, name in enumerate(attributes)}
    document = {
        "asset": {"version": "2.0", "generator": "glassplat"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"mode": POINTS, "attributes": names, "extensions": {EXTENSION: splats}}]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": data.nbytes, "target": ARRAY_BUFFER}
            for data, start in zip(arrays, starts, strict=True)
        ],
        "buffers": [{"byteLength": total}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    size = HEADER.size + 2 * CHUNK.size + len(text) + total
    if size > MOST_BYTES:
        raise ValueError(f"a GLB of {size} bytes cannot be written; expected at most {MOST_BYTES}: use PLY or SPZ")
    head = HEADER.pack(MAGIC, VERSION, size) + CHUNK.pack(len(text), JSON_CHUNK) + text
    return head + CHUNK.pack(total, BINARY_CHUNK) + b"".join(data.tobytes() for data in arrays)


def _placed_meshes(file: GltfReader) -> list[tuple[int, int, Tensor]]:
    """The meshes that the scene shows, each with its node and placement; a file without scenes shows all its nodes."""
    if len(file.list_of("nodes")) > MOST_NODES:
        raise ValueError(f"{file.path} has more than {MOST_NODES} nodes; expected fewer: export its splats alone")
    scenes = file.list_of("scenes")
    chosen = file.document.get("scene", 0)
    if scenes:
        index = chosen if isinstance(chosen, int) and 0 <= chosen < len(scenes) else len(scenes)
        roots = file.entry("scenes", index, SCENE)["nodes"]
    else:
        every = range(len(file.list_of("nodes")))
        below = {child for node in every for child in file.entry("nodes", node, NODE)["children"]}
        roots = [node for node in every if node not in below]
    pending: list[tuple[int, Tensor]] = [(node, torch.eye(4, dtype=torch.float64)) for node in roots]
    found: list[tuple[int, int, Tensor]] = []
    seen: set[int] = set()
    while pending:
        number, placement = pending.pop()
        if number in seen:
            raise ValueError(f"node {number} of {file.path} hangs below two others; expected a tree: it is damaged")
        seen.add(number)
        node = file.entry("nodes", number, NODE)
        placement = placement @ matrix_of(node)
        if node["mesh"] is not None:
            found.append((node["mesh"], number, placement))
        pending += [(child, placement) for child in node["children"]]
    return found


def _splat_primitives(file: GltfReader, mesh: int) -> list[dict[str, int]]:
    """Attributes of the splat primitives of a mesh."""
    where = f"mesh {mesh} of {file.path}"
    primitives = file.raw("meshes", mesh).get("primitives")
    if not isinstance(primitives, list):
        raise ValueError(f"{where} has no list of primitives; the file is damaged")
    found = []
    for index, entry in enumerate(primitives):
        primitive = records.check_fields(entry, PRIMITIVE, f"primitive {index} of {where}")
        extensions = entry.get("extensions")
        if not isinstance(extensions, dict) or EXTENSION not in extensions:
            continue
        splats = extensions[EXTENSION]
        records.check_fields(splats, SPLATS, f"{EXTENSION} of primitive {index} of {where}")
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
    scales = as_tensor(file.array(attributes[SCALE], 3))
    if bool((scales < 0).any()):
        raise ValueError(
            f"{where} has negative scales, as drafts of {EXTENSION} stored logarithms; expected the ratified form: "
            "export it with a newer version of the program that wrote it"
        )
    are_discs = bool((scales[:, 2] == 0).all()) and bool((scales[:, :DISC_SCALES] > 0).any())
    shares = as_tensor(file.array(attributes[OPACITY], 1))[:, 0]
    return Gaussians(
        means=as_tensor(file.array(attributes["POSITION"], 3)),
        quats=as_tensor(file.array(attributes[ROTATION], 4)).roll(1, dims=1),
        log_scales=scales[:, : DISC_SCALES if are_discs else 3].clamp(min=LEAST_SCALE).log(),
        logit_opacities=torch.logit(shares.double().clamp(LEAST_SHARE, 1 - LEAST_SHARE)).float(),
        sh=torch.stack([as_tensor(file.array(attributes[name], 3)) for name in names], dim=1),
        channels={name: as_tensor(file.array(attributes[stored], 1))[:, 0] for name, stored in channels.items()},
        active_sh_degree=degree,
    )


def _stored_degree(attributes: dict[str, int], where: str) -> int:
    """The highest SH degree with any coefficient."""
    prefix = f"{EXTENSION}:SH_DEGREE_"
    degrees = {name.removeprefix(prefix).partition("_")[0] for name in attributes if name.startswith(prefix)}
    if not degrees <= {str(degree) for degree in range(HIGHEST_DEGREE + 1)}:
        raise ValueError(f"{where} has harmonics of the degrees {sorted(degrees)}; expected 0 to {HIGHEST_DEGREE}")
    return max(map(int, degrees), default=0)


def _harmonic_names(count: int) -> list[str]:
    """Attribute names of the given number of SH coefficients: 1, 4, 9 or 16."""
    degrees = range(round(count**0.5))
    return [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for degree in degrees for n in range(2 * degree + 1)]


def _pad_gaussians(part: Gaussians, coefficients: int, *, are_discs: bool) -> Gaussians:
    """A set padded to the given number of coefficients, and to three scales unless all sets are discs."""
    sh = torch.nn.functional.pad(part.sh, (0, 0, 0, coefficients - part.sh.shape[1]))
    log_scales = part.log_scales
    if part.are_discs and not are_discs:
        log_scales = torch.nn.functional.pad(log_scales, (0, 1), value=float(np.log(LEAST_SCALE)))
    return replace(part, sh=sh, log_scales=log_scales)
