"""Gaussians as SPZ, Niantic's compressed format.

Up to version 3 the whole file, header and sections, is one gzip stream. Version 4 has an uncompressed header, a table
of section sizes, and one Zstandard stream per section.

An SPZ file has y up and z backwards where a PLY has y down and z forward; reading and writing rotate the scene
accordingly.
"""

from __future__ import annotations

import logging
import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import zstandard
from numpy.typing import NDArray
from torch import Tensor

from glassplat.files.ply import as_numpy, as_tensor
from glassplat.files.records import wrap_read_errors
from glassplat.files.writing import write_bytes
from glassplat.scene.gaussians import Gaussians, rotate_half_turn

log = logging.getLogger(__name__)

Bytes = NDArray[np.uint8]

HALF_TURN_X = (1.0, -1.0, -1.0)
"""Signs of a half turn around x, which converts to the frame of SPZ and the web page, and back."""
HARMONICS = (0, 3, 8, 15, 24)
"""Number of SH coefficients beyond degree 0, by degree; those of degree 4 are skipped."""
MOST_HARMONICS = HARMONICS[3]
COLOR_SCALE, LOWEST_LOG_SCALE, STEPS_PER_LOG = 0.15, -10.0, 16.0
"""Factor on SH coefficients of degree 0, lowest log scale, and quantisation steps per unit of log scale."""
LARGEST_POSITION, MOST_FRACTIONAL_BITS = 2**23 - 1, 20
"""Largest position as an integer, and maximum number of its fractional bits."""
QUAT_STEPS = 511
"""Quantisation steps of the three smallest quaternion components, on either side of zero."""


class Layout(NamedTuple):
    """Sections of the file as the header describes them.

    Attributes:
        version: of the format; 1 has half-precision positions, 3 and later have four bytes per rotation.
        number: of Gaussians.
        degree: SH degree, up to 4.
        fractional_bits: of the fixed-point positions.
    """

    version: int
    number: int
    degree: int
    fractional_bits: int

    def sizes(self) -> tuple[int, ...]:
        """Bytes of each section: positions, opacities, colours, scales, rotations, harmonics."""
        position = 6 if self.version == 1 else 9
        rotation = 4 if self.version >= 3 else 3
        return tuple(self.number * width for width in (position, 1, 3, 3, rotation, 3 * HARMONICS[self.degree]))


def fractional_bits_for(means: Tensor) -> int:
    """Number of fractional bits for which the largest coordinate still fits."""
    largest = float(means.abs().max()) if means.numel() else 0.0
    bits = MOST_FRACTIONAL_BITS
    while bits > 0 and largest * 2**bits > LARGEST_POSITION:
        bits -= 1
    return bits


def pack_sections(gaussians: Gaussians, layout: Layout) -> list[Bytes]:
    """The six sections of Gaussians in the capture's frame, for a layout of version 3 or 4."""
    gaussians = rotate_half_turn(gaussians, HALF_TURN_X)
    opacities = torch.sigmoid(gaussians.logit_opacities)
    return [
        _pack_positions(as_numpy(gaussians.means), layout.fractional_bits),
        _to_bytes(as_numpy(opacities) * 255),
        _to_bytes(as_numpy(gaussians.sh[:, 0]) * (COLOR_SCALE * 255) + 127.5),
        _to_bytes((as_numpy(three_log_scales(gaussians)) - LOWEST_LOG_SCALE) * STEPS_PER_LOG),
        _pack_rotations(as_numpy(gaussians.quats)),
        _to_bytes(as_numpy(gaussians.sh[:, 1:]) * 128 + 128),
    ]


def three_log_scales(gaussians: Gaussians) -> Tensor:
    """[N, 3] log scales; discs, which the format does not support, get its smallest third scale."""
    if not gaussians.are_discs:
        return gaussians.log_scales
    return torch.nn.functional.pad(gaussians.log_scales, (0, 1), value=LOWEST_LOG_SCALE)


def unpack_gaussians(sections: list[Bytes], layout: Layout) -> Gaussians:
    """The Gaussians of six sections, in the frame of a PLY; SH of degree 4 are dropped."""
    positions, opacities, colors, scales, rotations, harmonics = sections
    count, kept = layout.number, min(HARMONICS[layout.degree], MOST_HARMONICS)
    rest = harmonics.reshape(count, HARMONICS[layout.degree], 3)[:, :kept].astype(np.float32) / 128 - 1
    constant = (colors.reshape(count, 1, 3).astype(np.float32) / 255 - 0.5) / COLOR_SCALE
    shares = np.clip(opacities.astype(np.float32) / 255, 0.5 / 255, 1 - 0.5 / 255)
    stored = Gaussians(
        means=as_tensor(_unpack_positions(positions, layout)),
        quats=as_tensor(_unpack_rotations(rotations, layout)),
        log_scales=as_tensor(scales.reshape(count, 3).astype(np.float32) / STEPS_PER_LOG + LOWEST_LOG_SCALE),
        logit_opacities=torch.logit(as_tensor(shares)),
        sh=as_tensor(np.concatenate([constant, rest], axis=1)),
    )
    return rotate_half_turn(stored, HALF_TURN_X)


def _pack_positions(means: NDArray[np.float32], bits: int) -> Bytes:
    fixed = np.rint(means.astype(np.float64) * 2**bits).clip(-LARGEST_POSITION, LARGEST_POSITION).astype("<i4")
    return np.ascontiguousarray(fixed.reshape(-1, 1).view(np.uint8)[:, :3]).reshape(-1)


def _unpack_positions(section: Bytes, layout: Layout) -> NDArray[np.float32]:
    if layout.version == 1:
        halves = section.view("<f2").reshape(layout.number, 3)
        # NumPy warns about arithmetic with signalling NaNs; renderers skip NaNs.
        return np.where(np.isnan(halves), np.float32(np.nan), halves.astype(np.float32))
    padded = np.zeros((3 * layout.number, 4), dtype=np.uint8)
    padded[:, 1:] = section.reshape(-1, 3)
    # The shift extends the sign of the 24-bit values.
    fixed = padded.view("<i4").reshape(layout.number, 3) >> 8
    return fixed.astype(np.float32) / np.float32(2**layout.fractional_bits)


def _pack_rotations(quats: NDArray[np.float32]) -> Bytes:
    """The three smallest components of (x, y, z, w), ten bits each; the top two bits index the omitted one."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.roll(np.divide(quats, norms, out=np.zeros_like(quats), where=norms > 0), -1, axis=1)
    largest = np.abs(unit).argmax(axis=1)
    rows = np.arange(len(unit))
    unit = np.where(unit[rows, largest] < 0, -1, 1)[:, None] * unit
    packed = largest.astype(np.uint32)
    for component in range(4):
        value = unit[:, component]
        magnitude = np.minimum(np.abs(value) * (np.sqrt(2) * QUAT_STEPS) + 0.5, QUAT_STEPS).astype(np.uint32)
        pushed = (packed << np.uint32(10)) | ((value < 0).astype(np.uint32) << np.uint32(9)) | magnitude
        packed = np.where(largest == component, packed, pushed)
    return packed.astype("<u4").view(np.uint8)


def _unpack_rotations(section: Bytes, layout: Layout) -> NDArray[np.float32]:
    """Quaternions [N, 4] `wxyz`."""
    if layout.version < 3:
        vector = section.reshape(layout.number, 3).astype(np.float32) / 127.5 - 1
        real = np.sqrt((1 - (vector**2).sum(axis=1, keepdims=True)).clip(min=0))
        return np.concatenate([real, vector], axis=1).astype(np.float32)
    packed = section.view("<u4").copy()
    largest = packed >> np.uint32(30)
    quats = np.zeros((layout.number, 4), dtype=np.float32)
    for component in range(3, -1, -1):
        magnitude = (packed & np.uint32(QUAT_STEPS)).astype(np.float32) / (np.sqrt(2) * QUAT_STEPS)
        value = np.where(packed & np.uint32(512), -magnitude, magnitude)
        stored = largest != component
        quats[:, component] = np.where(stored, value, 0)
        packed = np.where(stored, packed >> np.uint32(10), packed)
    quats[np.arange(layout.number), largest] = np.sqrt((1 - (quats**2).sum(axis=1)).clip(min=0))
    return np.roll(quats, 1, axis=1)


def _to_bytes(values: NDArray[np.float32]) -> Bytes:
    return np.rint(values).clip(0, 255).astype(np.uint8).reshape(-1)


MAGIC, GZIP_WINDOW, VERSIONS = 0x5053474E, 31, (1, 2, 3, 4)
"""First number of a file, zlib's code for gzip streams, and the versions that are read."""
GZIP = b"\x1f\x8b"
HEADER = struct.Struct("<IIIBBBB")
STREAMED_HEADER = struct.Struct("<IIIBBBBI12x")
STREAM = struct.Struct("<QQ")
PLAIN_COUNT, GAUSSIANS_PER_BYTE = 2**20, 2
"""A file of B bytes may declare 2 B Gaussians, or a million; real ones take ten bytes, bombs 0.01."""


def write_spz(path: Path | str, gaussians: Gaussians, version: int = 3) -> None:
    """Writes shapes, opacities and colours of Gaussians as SPZ, atomically; channels are not stored.

    Positions have as many fractional bits as the scene's size permits; rotations have 10 bits, all else 8.

    Args:
        path: the file.
        gaussians: with colours, in the capture's frame.
        version: 3 or 4.
    """
    write_bytes(path, spz_bytes(gaussians, version))


def spz_bytes(gaussians: Gaussians, version: int = 3) -> bytes:
    """Bytes of an SPZ file."""
    if version not in (3, 4):
        raise ValueError(f"SPZ of version {version} cannot be written; expected 3 or 4")
    if gaussians.max_sh_degree < 0:
        raise ValueError("Gaussians without colours cannot be written as SPZ; expected f_dc_0 to f_dc_2")
    broken = [name for name, tensor in gaussians.tensors().items() if not bool(tensor.isfinite().all())]
    if broken:
        raise ValueError(
            f"Gaussians whose {', '.join(broken)} are not all finite cannot be written as SPZ; remove them with "
            "`glassplat clean`"
        )
    farthest = float(gaussians.means.abs().max()) if len(gaussians) else 0.0
    if farthest > LARGEST_POSITION:
        raise ValueError(
            f"a Gaussian lies {farthest:.3g} units from the origin, and SPZ ends at {LARGEST_POSITION}; remove "
            "it with `glassplat clean`, or write another format"
        )
    gaussians = replace(gaussians, sh=gaussians.sh[:, : (gaussians.active_sh_degree + 1) ** 2])
    layout = Layout(version, len(gaussians), gaussians.max_sh_degree, fractional_bits_for(gaussians.means))
    step = 2.0**-layout.fractional_bits
    if len(gaussians) and step > float(gaussians.log_scales.amax(dim=1).median().exp()):
        log.warning(
            "SPZ rounds positions to %g units, which is more than half of the Gaussians measure, because one lies %.3g "
            "units from the origin; remove it with `glassplat clean`, or write another format",
            step,
            farthest,
        )
    _warn_about_sizes(gaussians.log_scales)
    sections = [section.tobytes() for section in pack_sections(gaussians, layout)]
    header = (MAGIC, version, layout.number, layout.degree, layout.fractional_bits, 0)
    if version == 4:
        return _pack_streams(header, sections)
    packer = zlib.compressobj(9, zlib.DEFLATED, GZIP_WINDOW)
    return packer.compress(HEADER.pack(*header, 0) + b"".join(sections)) + packer.flush()


MOST_CLIPPED = 0.001
"""Share of Gaussians whose scales may be clipped without a warning."""
THIN_LOG_RATIO = 3.0
"""Log ratio of length to thickness above which the thickness of a Gaussian is invisible."""


def _warn_about_sizes(log_scales: Tensor) -> None:
    """Warns if many Gaussians are too large for SPZ, or so small that clipping visibly thickens them."""
    lowest, highest, tolerance = LOWEST_LOG_SCALE, LOWEST_LOG_SCALE + 255 / STEPS_PER_LOG, 0.5 / STEPS_PER_LOG
    largest, smallest = log_scales.amax(dim=1), log_scales.amin(dim=1)
    small = (smallest < lowest - tolerance) & (largest < lowest + THIN_LOG_RATIO)
    share = float((small | (largest > highest + tolerance)).double().mean())
    if share > MOST_CLIPPED:
        log.warning(
            "SPZ and the web page hold sizes of %.2g to %.3g units; those of %.3g %% of the Gaussians are "
            "clipped and look different. Change the units of the scene with `glassplat clean --scale`, or write a PLY",
            math.exp(lowest),
            math.exp(highest),
            100 * share,
        )


def read_spz(path: Path | str) -> Gaussians:
    """Reads an SPZ file of version 1 to 4 into the frame of a PLY; SH of degree 4 are dropped.

    Memory is bounded by the largest count accepted for a file of this size, whatever is compressed in it.
    """
    path = Path(path)
    with wrap_read_errors(path):
        data = path.read_bytes()
    if data.startswith(GZIP):
        layout, sections = _read_gzip(data, path)
    elif data[:4] == struct.pack("<I", MAGIC):
        layout, sections = _read_streams(data, path)
    else:
        raise ValueError(f"{path} is not an SPZ file: expected it to begin with gzip or NGSP; give a .spz file")
    return unpack_gaussians(sections, layout)


def _pack_streams(header: tuple[int, ...], sections: list[bytes]) -> bytes:
    """Header, table of sizes, and the non-empty sections."""
    stored = [section for section in sections if section]
    packed = [zstandard.ZstdCompressor(level=12).compress(section) for section in stored]
    table = b"".join(STREAM.pack(len(p), len(s)) for p, s in zip(packed, stored, strict=True))
    return STREAMED_HEADER.pack(*header, len(stored), STREAMED_HEADER.size) + table + b"".join(packed)


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
        # One extra byte reveals a longer stream; nothing beyond is unpacked.
        body = unpacker.decompress(unpacker.unconsumed_tail, size + 1)
    except zlib.error as error:
        raise ValueError(
            f"{path} cannot be unpacked ({error}); the file is damaged: copy or export it again"
        ) from error
    if len(body) < size:
        raise ValueError(
            f"{path} is cut off: its header announces {layout.number} Gaussians, which take {size} bytes, but "
            f"it has {len(body)}; copy or export it again"
        )
    *ends, _ = np.cumsum(layout.sizes())
    return layout, np.split(np.frombuffer(body, dtype=np.uint8, count=size), ends)


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
                f"section {index} of {path} has {announced} bytes, packed in {packed}; expected {size}, packed "
                "in the rest of the file: it is cut off or damaged"
            )
        found.append(_unpack_stream(data[at : at + packed], size, index, path))
        at += packed
    sections = iter(found)
    return layout, [next(sections) if size else np.zeros(0, dtype=np.uint8) for size in layout.sizes()]


def _unpack_stream(packed: bytes, size: int, index: int, path: Path) -> Bytes:
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
    """Layout from the header, checked for plausibility."""
    if len(header) < HEADER.size:
        raise ValueError(f"{path} ends within its header; the file is cut off: copy or export it again")
    magic, version, count, degree, bits, *_ = HEADER.unpack(header)
    if magic != MAGIC:
        raise ValueError(f"{path} is compressed, but not SPZ: expected NGSP at its beginning; give a .spz file")
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
