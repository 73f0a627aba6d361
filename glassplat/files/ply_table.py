"""The PLY container: a header and one table of scalar columns per element, independent of Gaussians."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from glassplat.files.records import wrap_read_errors
from glassplat.files.writing import atomic_write

SCALAR_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
LONGEST_HEADER_LINE, MOST_HEADER_LINES = 4096, 10_000
"""Limits of a header, so that a file without its end is not read as one."""


@dataclass(frozen=True)
class PlyElement:
    """One table declared in a header; the type `None` marks a list property."""

    name: str
    count: int
    properties: dict[str, str | None]

    @property
    def has_lists(self) -> bool:
        """Return whether rows may differ in length, so that the table cannot be skipped or read at once."""
        return None in self.properties.values()

    def row_type(self, byte_order: str) -> np.dtype:
        """Data type of a packed row in a binary file."""
        return np.dtype([(name, byte_order + str(kind)) for name, kind in self.properties.items()])


@dataclass(frozen=True)
class PlyHeader:
    """Format (`ascii`, `binary_little_endian`, `binary_big_endian`) and tables in file order."""

    format: str
    elements: tuple[PlyElement, ...]

    def element(self, name: str) -> PlyElement | None:
        """The table of that name, or None."""
        return next((element for element in self.elements if element.name == name), None)


@dataclass(frozen=True)
class PlyTable:
    """One table read into memory: its header and its columns, in native byte order."""

    header: PlyHeader
    columns: Mapping[str, NDArray]


def read_table(path: Path, name: str = "vertex") -> PlyTable:
    """Reads one table of scalar properties from a PLY file of any of the three formats.

    Args:
        path: the file.
        name: element to read; later elements are ignored.
    """
    if not os.path.isfile(path):
        raise FileNotFoundError(f"no PLY file at {path}; check the path")
    with wrap_read_errors(path), path.open("rb") as stream:
        header = read_header(stream, path)
        element = header.element(name)
        if element is None:
            found = [element.name for element in header.elements]
            raise ValueError(
                f"{path} has no element {name!r}; expected one, found {found}. Is it another kind of PLY file?"
            )
        if element.has_lists or not element.properties:
            found_kind = "list properties" if element.has_lists else "no properties"
            raise ValueError(
                f"element {name!r} of {path} has {found_kind}; expected plain numbers. Export it with nothing else"
            )
        earlier = header.elements[: header.elements.index(element)]
        if header.format == "ascii":
            return PlyTable(header, _read_ascii(stream, element, earlier, path))
        return PlyTable(header, _read_binary(stream, element, earlier, BYTE_ORDERS[header.format], path))


COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))


def point_colors(columns: Mapping[str, NDArray]) -> NDArray | None:
    """[N, 3] the columns red, green and blue, or their other names, from 0 to 255; None if one is missing.

    Floats that never exceed one are multiplied by 255, because some programs write colours that way.
    """
    names = next((names for names in COLORS if columns.keys() >= set(names)), None)
    if names is None:
        return None
    colors = np.stack([columns[name] for name in names], axis=1)
    shares = np.issubdtype(colors.dtype, np.floating) and colors.max(initial=0) <= 1
    return colors * 255 if shares else colors


def write_table(path: Path, names: list[str], rows: NDArray[np.float32]) -> None:
    """Writes one `vertex` table [N, P] of float properties, binary little endian, atomically.

    Args:
        path: the file; replaced completely or not at all.
        names: the P property names in order.
        rows: the values.
    """
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {rows.shape[0]}"]
    header += [f"property float {name}" for name in names] + ["end_header"]
    with atomic_write(path) as temporary_path, temporary_path.open("wb") as stream:
        stream.write(("\n".join(header) + "\n").encode("ascii"))
        stream.write(np.ascontiguousarray(rows, dtype="<f4").data)


def read_header(stream: BinaryIO, path: Path) -> PlyHeader:
    """Parses the header; the stream ends up at the first byte of the data."""
    if stream.readline(LONGEST_HEADER_LINE).rstrip() != b"ply":
        raise ValueError(
            f"{path} is not a PLY file: expected its first line to be 'ply'. Give a Gaussian-splatting .ply file"
        )
    ply_format = ""
    elements: list[PlyElement] = []
    for words in _header_lines(stream, path):
        if words[0] == "format" and len(words) == 3 and words[1] in BYTE_ORDERS:
            ply_format = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdigit():
            elements.append(PlyElement(words[1], int(words[2]), {}))
        elif words[0] == "property" and elements:
            _add_property(elements[-1], words, path)
        else:
            raise ValueError(f"cannot read the line {' '.join(words)!r} in the header of {path}; the file is damaged")
    if not ply_format:
        raise ValueError(f"the header of {path} has no 'format' line; the file is damaged: export it again")
    return PlyHeader(ply_format, tuple(elements))


def _header_lines(stream: BinaryIO, path: Path) -> list[list[str]]:
    """Header lines up to `end_header`, split into words, without comments."""
    lines: list[list[str]] = []
    while len(lines) < MOST_HEADER_LINES:
        line = stream.readline(LONGEST_HEADER_LINE)
        words = line.decode("ascii", errors="replace").split()
        if not line.endswith(b"\n"):
            break
        if words == ["end_header"]:
            return lines
        if words and words[0] not in ("comment", "obj_info"):
            lines.append(words)
    raise ValueError(
        f"the header of {path} has no 'end_header' line; the file is cut off or damaged: export or copy it again"
    )


def _add_property(element: PlyElement, words: list[str], path: Path) -> None:
    is_list = len(words) == 5 and words[1] == "list"
    is_scalar = len(words) == 3 and words[1] in SCALAR_TYPES
    if not (is_list or is_scalar):
        raise ValueError(
            f"cannot read the property line {' '.join(words)!r} in the header of {path}; the file is damaged"
        )
    if words[-1] in element.properties:
        raise ValueError(
            f"property {words[-1]!r} appears twice in element {element.name!r} of {path}; expected each once"
        )
    element.properties[words[-1]] = SCALAR_TYPES[words[1]] if is_scalar else None


def _read_binary(
    stream: BinaryIO, element: PlyElement, earlier: tuple[PlyElement, ...], byte_order: str, path: Path
) -> dict[str, NDArray]:
    """Columns of one table of a binary file; sizes are checked before anything is allocated."""
    if any(other.has_lists for other in earlier):
        raise ValueError(
            f"{path} stores lists before element {element.name!r}; expected that element first. Export it again"
        )
    skipped = sum(other.count * other.row_type(byte_order).itemsize for other in earlier)
    row_type = element.row_type(byte_order)
    available = os.fstat(stream.fileno()).st_size - stream.tell() - skipped
    if available < element.count * row_type.itemsize:
        complete = max(available, 0) // max(row_type.itemsize, 1)
        raise _truncation_error(path, element, complete)
    stream.seek(skipped, os.SEEK_CUR)
    rows = np.fromfile(stream, dtype=row_type, count=element.count)
    return {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in element.properties}


def _read_ascii(
    stream: BinaryIO, element: PlyElement, earlier: tuple[PlyElement, ...], path: Path
) -> dict[str, NDArray]:
    """Columns of one table of a text file; every row is a line."""
    lines = [line for line in stream.read().split(b"\n") if line.strip()]
    first = sum(other.count for other in earlier)
    rows = [line.split() for line in lines[first : first + element.count]]
    width = len(element.properties)
    complete = next((index for index, row in enumerate(rows) if len(row) != width), len(rows))
    if complete < element.count:
        raise _truncation_error(path, element, complete)
    try:
        values = np.array(rows, dtype=np.float64).reshape(element.count, width)
    except ValueError as error:
        raise ValueError(f"{path} contains something that is not a number ({error}); the file is damaged") from error
    return {
        name: _convert_to_declared_type(values[:, i], str(kind), name, path)
        for i, (name, kind) in enumerate(element.properties.items())
    }


def _convert_to_declared_type(values: NDArray[np.float64], kind: str, name: str, path: Path) -> NDArray:
    """A column of a text file in its declared type; out of range, floats become infinite and integers are refused."""
    if not kind.startswith("f"):
        limits = np.iinfo(kind)
        inside = (values >= limits.min) & (values <= limits.max)
        if not inside.all():
            raise ValueError(
                f"property {name!r} of {path} is {values[~inside][0]:g} somewhere; expected whole numbers from "
                f"{limits.min} to {limits.max}, as the header says"
            )
    with np.errstate(over="ignore"):
        return values.astype(kind)


def _truncation_error(path: Path, element: PlyElement, complete: int) -> ValueError:
    return ValueError(
        f"{path} is cut off: its header announces {element.count} rows of {element.name!r}, "
        f"but only {complete} are complete; copy or export the file again"
    )
