"""Gaussians as SPZ, a compressed file of some 20 to 60 bytes each: versions 1 to 4 are read, 3 and 4 written.

Up to version 3 the whole file is one gzip stream: header and sections. Version 4 has a plain header, a table of the
sections' sizes, and each section as a stream of its own, compressed with Zstandard.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import zstandard

from glassplat.files.atomic import atomic_write
from glassplat.files.reading import reading
from glassplat.files.spz_sections import (
    HARMONICS,
    MOST_FRACTIONAL_BITS,
    Bytes,
    Layout,
    fractional_bits_for,
    packed_sections,
    unpacked,
)
from glassplat.scene.gaussians import Gaussians

MAGIC = 0x5053474E
GZIP = b"\x1f\x8b"
HEADER = struct.Struct("<IIIBBBB")
STREAMED_HEADER = struct.Struct("<IIIBBBBI12x")
STREAM = struct.Struct("<QQ")
VERSIONS = (1, 2, 3, 4)
GZIP_WINDOW = 31
PLAIN_COUNT, GAUSSIANS_PER_BYTE = 2**20, 2
"""A file of B bytes may announce 2 B Gaussians, or a million: real scenes take ten bytes each, bombs a hundredth."""


def write_spz(path: Path | str, gaussians: Gaussians, version: int = 3) -> None:
    """Writes the Gaussians' shapes, opacities and colours as SPZ, atomically; channels have no place in it.

    Positions keep as many bits behind the point as the scene's size leaves; everything else has 8 bits, rotations 10.

    Args:
        path: the file.
        gaussians: with colours, in the capture's frame.
        version: 3 or 4.

    Raises:
        ValueError: another version, no colours, or a value that is not finite.
    """
    data = spz_bytes(gaussians, version)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def spz_bytes(gaussians: Gaussians, version: int = 3) -> bytes:
    """What `write_spz` writes."""
    if version not in (3, 4):
        raise ValueError(f"SPZ of version {version} cannot be written; expected 3 or 4")
    if gaussians.max_sh_degree < 0:
        raise ValueError("Gaussians without colours cannot be written as SPZ; expected f_dc_0 to f_dc_2")
    broken = [name for name, tensor in gaussians.tensors().items() if not bool(tensor.isfinite().all())]
    if broken:
        raise ValueError(f"Gaussians whose {', '.join(broken)} are not all finite cannot be written as SPZ")
    gaussians = replace(gaussians, sh=gaussians.sh[:, : (gaussians.active_sh_degree + 1) ** 2])
    layout = Layout(version, len(gaussians), gaussians.max_sh_degree, fractional_bits_for(gaussians.means))
    sections = [section.tobytes() for section in packed_sections(gaussians, layout)]
    head = (MAGIC, version, layout.number, layout.degree, layout.fractional_bits, 0)
    if version == 4:
        return _streamed(head, sections)
    packer = zlib.compressobj(9, zlib.DEFLATED, GZIP_WINDOW)
    return packer.compress(HEADER.pack(*head, 0) + b"".join(sections)) + packer.flush()


def read_spz(path: Path | str) -> Gaussians:
    """Reads an SPZ file of versions 1 to 4 into the frame of a PLY; harmonics of the fourth degree are left out.

    Memory stays in proportion to what the header may claim for a file of this size, whatever is compressed in it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another kind of file, a version of the future, damaged, cut off, or a size that cannot be true.
    """
    path = Path(path)
    with reading(path):
        data = path.read_bytes()
    if data.startswith(GZIP):
        layout, sections = _read_gzip(data, path)
    elif data[:4] == struct.pack("<I", MAGIC):
        layout, sections = _read_streams(data, path)
    else:
        raise ValueError(f"{path} is no SPZ file: expected it to begin with gzip or NGSP; give a .spz file")
    return unpacked(sections, layout)


def _streamed(head: tuple[int, ...], sections: list[bytes]) -> bytes:
    """Header, table of sizes, and the sections that are not empty."""
    stored = [section for section in sections if section]
    packed = [zstandard.ZstdCompressor(level=12).compress(section) for section in stored]
    table = b"".join(STREAM.pack(len(p), len(s)) for p, s in zip(packed, stored, strict=True))
    return STREAMED_HEADER.pack(*head, len(stored), STREAMED_HEADER.size) + table + b"".join(packed)


def _read_gzip(data: bytes, path: Path) -> tuple[Layout, list[Bytes]]:
    unpacker = zlib.decompressobj(GZIP_WINDOW)
    try:
        header = unpacker.decompress(data, HEADER.size)
        layout = _layout(header, len(data), path)
        if layout.version == 4:
            raise ValueError(
                f"{path} says that it is SPZ of version 4, which is not compressed as a whole; it is damaged"
            )
        size = sum(layout.sizes())
        # One byte more than expected shows that there are more; nothing beyond is ever unpacked.
        body = unpacker.decompress(unpacker.unconsumed_tail, size + 1)
    except zlib.error as error:
        raise ValueError(
            f"{path} cannot be unpacked ({error}); the file is damaged: copy or export it again"
        ) from error
    if len(body) < size:
        raise ValueError(
            f"{path} is cut off: its header announces {layout.number} Gaussians, which take {size} bytes, but "
            f"{len(body)} are there; copy or export it again"
        )
    whole, at, sections = np.frombuffer(body, dtype=np.uint8), 0, []
    for length in layout.sizes():
        sections.append(whole[at : at + length])
        at += length
    return layout, sections


def _read_streams(data: bytes, path: Path) -> tuple[Layout, list[Bytes]]:
    layout = _layout(data[: HEADER.size], len(data), path)
    if layout.version != 4 or len(data) < STREAMED_HEADER.size:
        raise ValueError(f"{path} begins as SPZ of version 4 does, but is cut off or damaged; export it again")
    *_, count, table = STREAMED_HEADER.unpack_from(data)
    expected = [size for size in layout.sizes() if size]
    at = table + count * STREAM.size
    if count != len(expected) or at > len(data):
        raise ValueError(
            f"{path} announces {count} sections from byte {table} on; expected {len(expected)} within its {len(data)} "
            "bytes: the file is cut off or damaged"
        )
    found = []
    for index, size in enumerate(expected):
        packed, announced = STREAM.unpack_from(data, table + index * STREAM.size)
        if announced != size or packed > len(data) - at:
            raise ValueError(
                f"section {index} of {path} has {announced} bytes, packed in {packed}; expected {size}, packed in what "
                "is left of the file: it is cut off or damaged"
            )
        found.append(_unpacked_stream(data[at : at + packed], size, index, path))
        at += packed
    sections = iter(found)
    return layout, [next(sections) if size else np.zeros(0, dtype=np.uint8) for size in layout.sizes()]


def _unpacked_stream(packed: bytes, size: int, index: int, path: Path) -> Bytes:
    try:
        with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(packed) as stream:
            section = stream.read(size + 1)
    except zstandard.ZstdError as error:
        raise ValueError(f"section {index} of {path} cannot be unpacked ({error}); the file is damaged") from error
    if len(section) != size:
        more = "more than" if len(section) > size else "only"
        raise ValueError(f"section {index} of {path} holds {more} {min(len(section), size)} bytes; expected {size}")
    return np.frombuffer(section, dtype=np.uint8)


def _layout(header: bytes, file_size: int, path: Path) -> Layout:
    """What the header says, as far as it can be true."""
    if len(header) < HEADER.size:
        raise ValueError(f"{path} ends within its header; the file is cut off: copy or export it again")
    magic, version, count, degree, bits, *_ = HEADER.unpack(header)
    if magic != MAGIC:
        raise ValueError(f"{path} is compressed, but no SPZ: expected NGSP at its beginning; give a .spz file")
    if version not in VERSIONS:
        raise ValueError(f"{path} is SPZ of version {version}; expected one of {VERSIONS}: save it in an earlier one")
    if degree >= len(HARMONICS) or (bits > MOST_FRACTIONAL_BITS + 4 and version > 1):
        raise ValueError(
            f"{path} has harmonics of degree {degree} and positions with {bits} fractional bits; expected at most "
            f"{len(HARMONICS) - 1} and {MOST_FRACTIONAL_BITS + 4}: the file is damaged"
        )
    if count > max(PLAIN_COUNT, GAUSSIANS_PER_BYTE * file_size):
        raise ValueError(
            f"{path} announces {count} Gaussians in {file_size} bytes, which no scene can be packed in; it is damaged"
        )
    return Layout(version, count, degree, bits)
