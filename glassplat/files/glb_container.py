"""Binary glTF 2.0: a JSON document and one buffer, and arrays of numbers (accessors) in it."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glassplat.files.fields import ByName, Choice, Field, Flag, Items, Number, Optional, Text, Whole, checked, shown
from glassplat.files.json_text import parse_json
from glassplat.files.reading import LARGEST_TEXT, reading

MAGIC, VERSION = b"glTF", 2
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
FLOAT, ARRAY_BUFFER = 5126, 34962
COMPONENTS: dict[int, str] = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MOST_BYTES = 2**32 - 1

INDEX = Whole(0, 2**31)
ACCESSOR: dict[str, Field] = {
    "bufferView": INDEX,
    "byteOffset": Optional(Whole(0, MOST_BYTES), 0),
    "componentType": Choice(tuple(COMPONENTS)),
    "normalized": Optional(Flag(), False),
    "count": Whole(1, MOST_BYTES),
    "type": Choice(tuple(WIDTHS)),
}
VIEW: dict[str, Field] = {
    "buffer": Whole(0, 0),
    "byteOffset": Optional(Whole(0, MOST_BYTES), 0),
    "byteLength": Whole(1, MOST_BYTES),
    "byteStride": Optional(Whole(4, 252)),
}
NODE: dict[str, Field] = {
    "mesh": Optional(INDEX),
    "children": Optional(Items(INDEX), ()),
    "matrix": Optional(Items(Number(-1e12, 1e12), 16)),
    "translation": Optional(Items(Number(-1e12, 1e12), 3), (0.0, 0.0, 0.0)),
    "rotation": Optional(Items(Number(-1.01, 1.01), 4), (0.0, 0.0, 0.0, 1.0)),
    "scale": Optional(Items(Number(-1e12, 1e12), 3), (1.0, 1.0, 1.0)),
}
PRIMITIVE: dict[str, Field] = {"attributes": ByName(INDEX), "mode": Optional(Whole(0, 6), 4)}
SCENE: dict[str, Field] = {"nodes": Optional(Items(INDEX), ())}
ASSET: dict[str, Field] = {"version": Text()}


class GltfWriter:
    """Collects arrays, and writes them with a document that refers to them by number."""

    def __init__(self) -> None:
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, values: NDArray[np.float32], *, bounded: bool = False) -> int:
        """Adds float32 rows [N] or [N, 2 to 4]; returns the number of their accessor.

        Args:
            values: at least one row.
            bounded: write the least and the greatest value of each column, as positions need them.
        """
        data = np.ascontiguousarray(values, dtype="<f4")
        kind = "SCALAR" if data.ndim == 1 else f"VEC{data.shape[1]}"
        accessor: dict[str, Any] = {"bufferView": len(self._views), "componentType": FLOAT, "count": len(data)}
        accessor["type"] = kind
        if bounded:
            accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        length = data.nbytes
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": length, "target": ARRAY_BUFFER}
        self._views.append(view)
        self._parts.append(data.tobytes())
        self._size += length
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def file(self, document: Mapping[str, Any]) -> bytes:
        """The GLB of a document, to which the arrays are added.

        Raises:
            ValueError: more than 4 GiB, which the format cannot hold.
        """
        whole = {**document, "accessors": self._accessors, "bufferViews": self._views}
        whole["buffers"] = [{"byteLength": self._size}]
        text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        size = HEADER.size + 2 * CHUNK.size + len(text) + self._size
        if size > MOST_BYTES:
            raise ValueError(f"a GLB of {size} bytes cannot be written; expected at most {MOST_BYTES}: take PLY or SPZ")
        head = HEADER.pack(MAGIC, VERSION, size) + CHUNK.pack(len(text), JSON_CHUNK) + text
        return head + CHUNK.pack(self._size, BINARY_CHUNK) + b"".join(self._parts)


class GltfReader:
    """A GLB file whose buffer is inside; what it says is checked where it is used."""

    def __init__(self, path: Path) -> None:
        """Reads the file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: another kind of file, another version, damaged or cut off, or without a document.
        """
        with reading(path):
            data = path.read_bytes()
        self.path, self.size = path, len(data)
        text, self._buffer = _chunks(data, path)
        document = parse_json(text, str(path))
        if not isinstance(document, dict):
            raise ValueError(f"{path} holds {shown(document)}; expected a glTF document")
        self.document: dict[str, Any] = document
        version = checked(document.get("asset"), ASSET, f"asset of {path}")["version"]
        if version.partition(".")[0] != str(VERSION):
            raise ValueError(f"{path} is glTF of version {version}; expected 2.0: export it again")

    def listed(self, kind: str) -> list[Any]:
        """The list of that name in the document; empty where there is none."""
        found = self.document.get(kind, [])
        if not isinstance(found, list):
            raise ValueError(f"{kind} of {self.path} is {shown(found)}; expected a list")
        return found

    def entry(self, kind: str, index: int, fields: Mapping[str, Field]) -> dict[str, Any]:
        """The checked fields of one entry of a list."""
        return checked(self.raw(kind, index), fields, f"entry {index} of {kind} in {self.path}")

    def raw(self, kind: str, index: int) -> dict[str, Any]:
        """One entry of a list as it is; its extensions are nobody else's to check."""
        found = self.listed(kind)
        if index >= len(found) or not isinstance(found[index], dict):
            raise ValueError(f"{self.path} refers to entry {index} of {kind}, which is not there; it is damaged")
        entry: dict[str, Any] = found[index]
        return entry

    def count(self, index: int) -> int:
        """How many rows an accessor has."""
        return int(self.entry("accessors", index, ACCESSOR)["count"])

    def array(self, index: int, width: int) -> NDArray[np.float32]:
        """The rows [N, width] of an accessor as float32, dequantised where they are normalised.

        Raises:
            ValueError: another width, or bytes that are not there.
        """
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
        return _dequantised(rows, normalized=accessor["normalized"])


def _chunks(data: bytes, path: Path) -> tuple[str, bytes]:
    """The document's text, and the buffer, which may be empty."""
    if len(data) < HEADER.size + CHUNK.size or data[:4] != MAGIC:
        raise ValueError(f"{path} is no GLB: expected glTF at its beginning; give a .glb file")
    _, version, announced = HEADER.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"{path} is a GLB of version {version}; expected 2: export it again")
    size, kind = CHUNK.unpack_from(data, HEADER.size)
    start = HEADER.size + CHUNK.size
    if announced > len(data) or kind != JSON_CHUNK or not 0 < size <= min(announced - start, LARGEST_TEXT):
        raise ValueError(
            f"{path} announces {announced} bytes, {size} of them its document, but has {len(data)}; it is cut off or "
            "damaged"
        )
    try:
        text = data[start : start + size].decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"the document of {path} is no text in UTF-8 ({error.reason}); it is damaged") from error
    at = start + size
    if at + CHUNK.size > announced:
        return text, b""
    size, kind = CHUNK.unpack_from(data, at)
    if kind != BINARY_CHUNK or at + CHUNK.size + size > len(data):
        raise ValueError(f"the buffer of {path} has {size} bytes, which are not all there; it is cut off or damaged")
    return text, data[at + CHUNK.size : at + CHUNK.size + size]


def _dequantised(rows: NDArray, *, normalized: bool) -> NDArray[np.float32]:
    """Whole numbers as shares of the greatest, where they are normalised; at least -1 (glTF 2.0, Section 3.11)."""
    values: NDArray[np.float32] = rows.astype(np.float32)
    if normalized and rows.dtype.kind in "iu":
        values = np.maximum(values / np.float32(np.iinfo(rows.dtype).max), np.float32(-1))
    return values
