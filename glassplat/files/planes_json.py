"""Reflection planes as a small JSON file beside the PLY."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from glassplat.files.atomic import atomic_write
from glassplat.scene.plane import Planes

EDIT_TOLERANCE = 1e-5
"""Above this difference the readable value has been edited by hand, and wins over the raw one."""
REFLECTANCE_MARGIN = 1e-6
VECTORS = {"center": 3, "normal": 3, "tangent": 3, "half_sizes": 2}


def write_planes(path: Path | str, planes: Planes) -> None:
    """Writes planes as a JSON list, atomically; `read_planes` gives back the same float32 bits.

    Each entry has label, mirror, center, normal (unit), tangent, half_sizes and base_reflectance for people
    and other programs (world units, the capture's frame), and the raw values raw_normal and
    logit_reflectance that training continues from.

    Raises:
        ValueError: a plane holds a value that is not finite.
    """
    entries = [_entry(planes, index) for index in range(len(planes))]
    for entry in entries:
        broken = [key for key, value in entry.items() if not _finite(value)]
        if broken:
            raise ValueError(
                f"plane {entry['label']} cannot be written: {', '.join(broken)} must be finite, but is not"
            )
    with atomic_write(path) as temporary_path:
        temporary_path.write_text(json.dumps(entries, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_planes(path: Path | str) -> Planes:
    """Reads planes as float32 tensors.

    A file edited by hand works as expected: where `normal` or `base_reflectance` no longer agrees with
    its raw value, or the raw value is missing, the readable one is taken.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not a list of planes, a missing or malformed value, or a label that appears twice.
    """
    path = Path(path)
    entries = _load_entries(path)
    if not entries:
        return Planes.empty()
    labels = tuple(_label(entry, path) for entry in entries)
    if len(set(labels)) != len(labels):
        raise ValueError(f"{path} has plane labels {list(labels)}; expected every label once")
    vectors = {key: torch.stack([_vector(entry, key, path) for entry in entries]) for key in VECTORS}
    return Planes(
        centers=vectors["center"],
        raw_normals=torch.stack([_raw_normal(entry, path) for entry in entries]),
        logit_reflectances=torch.stack([_logit_reflectance(entry, path) for entry in entries]),
        tangents=vectors["tangent"],
        half_sizes=vectors["half_sizes"],
        labels=labels,
        mirrors=tuple(label for label, entry in zip(labels, entries, strict=True) if _is_mirror(entry, path)),
    )


def _entry(planes: Planes, index: int) -> dict[str, Any]:
    """One plane as plain numbers; a float32 survives the way through a decimal double unchanged."""
    return {
        "label": int(planes.labels[index]),
        "mirror": planes.labels[index] in planes.mirrors,
        "center": planes.centers[index].tolist(),
        "normal": planes.normals[index].tolist(),
        "tangent": planes.tangents[index].tolist(),
        "half_sizes": planes.half_sizes[index].tolist(),
        "base_reflectance": planes.base_reflectances[index].item(),
        "raw_normal": planes.raw_normals[index].tolist(),
        "logit_reflectance": planes.logit_reflectances[index].item(),
    }


def _finite(value: float | list[float]) -> bool:
    return all(math.isfinite(number) for number in (value if isinstance(value, list) else [value]))


def _load_entries(path: Path) -> list[Mapping[str, Any]]:
    if not path.is_file():
        raise FileNotFoundError(f"no planes file at {path}; expected the planes.json of a run")
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"{path} is not valid JSON ({error}); it is damaged or cut off: restore or write it again"
        ) from error
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"{path} must hold a JSON list with one object per plane; found {type(entries).__name__}")
    return entries


def _label(entry: Mapping[str, Any], path: Path) -> int:
    label = entry.get("label")
    if not isinstance(label, int) or isinstance(label, bool) or label < 1:
        raise ValueError(f"a plane in {path} has the label {label!r}; expected a whole number of at least 1")
    return label


def _is_mirror(entry: Mapping[str, Any], path: Path) -> bool:
    mirror = entry.get("mirror", False)
    if not isinstance(mirror, bool):
        raise ValueError(f"plane {entry['label']} in {path} has mirror = {mirror!r}; expected true or false")
    return mirror


def _vector(entry: Mapping[str, Any], key: str, path: Path) -> Tensor:
    """A finite vector of the length that `key` has."""
    length = VECTORS[key.removeprefix("raw_")]
    value = entry.get(key)
    is_vector = isinstance(value, list) and len(value) == length
    if not is_vector or not all(_is_number(number) for number in value or ()):
        raise ValueError(f"plane {entry['label']} in {path} has {key} = {value!r}; expected {length} finite numbers")
    return torch.tensor(value, dtype=torch.float32)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _raw_normal(entry: Mapping[str, Any], path: Path) -> Tensor:
    normal = _vector(entry, "normal", path)
    if normal.norm() < 1e-6:
        raise ValueError(f"plane {entry['label']} in {path} has a normal of length 0; expected a direction")
    if "raw_normal" not in entry:
        return normal
    raw = _vector(entry, "raw_normal", path)
    unit, raw_unit = (torch.nn.functional.normalize(vector, dim=0) for vector in (normal, raw))
    return raw if (unit - raw_unit).abs().max() <= EDIT_TOLERANCE else normal


def _logit_reflectance(entry: Mapping[str, Any], path: Path) -> Tensor:
    reflectance = entry.get("base_reflectance")
    if not _is_number(reflectance) or not 0 <= float(reflectance or 0) <= 1:
        raise ValueError(
            f"plane {entry['label']} in {path} has base_reflectance = {reflectance!r}; expected a number from 0 to 1"
        )
    readable = torch.tensor(reflectance, dtype=torch.float32)
    raw = entry.get("logit_reflectance")
    if _is_number(raw):
        logit = torch.tensor(raw, dtype=torch.float32)
        if (torch.sigmoid(logit) - readable).abs() <= EDIT_TOLERANCE:
            return logit
    return torch.logit(readable, eps=REFLECTANCE_MARGIN)
