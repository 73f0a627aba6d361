"""Reflection planes as a small JSON file beside the PLY."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from glassplat.files.atomic import atomic_write
from glassplat.files.fields import (
    COORDINATE,
    LARGEST_COORDINATE,
    Field,
    Flag,
    Items,
    Number,
    Optional,
    Whole,
    checked,
    shown,
)
from glassplat.files.json_text import read_json
from glassplat.scene.plane import Planes

EDIT_TOLERANCE = 1e-5
"""Above this difference the readable value has been edited by hand, and wins over the raw one."""
REFLECTANCE_MARGIN = 1e-6
LEAST_LENGTH = 1e-6
LEAST_ANGLE = 1e-3
"""Between tangent and normal, in radians: below it the rectangle's sides have no direction."""
LEAST_HALF_SIZE = 1e-9
GLASS_REFLECTANCE = 0.2
"""That learning starts at, where nobody says."""
LEAST_TRANSMITTANCE, LARGEST_TRANSMITTANCE = 1e-6, 1.0
HIGHEST_LABEL = 255
VECTOR = Items(COORDINATE, 3)
LOGIT = Number(-1e3, 1e3)
PLANE: dict[str, Field] = {
    "label": Whole(1, HIGHEST_LABEL),
    "mirror": Optional(Flag(), default=False),
    "center": VECTOR,
    "normal": VECTOR,
    "tangent": VECTOR,
    "half_sizes": Items(Number(LEAST_HALF_SIZE, LARGEST_COORDINATE), 2),
    "base_reflectance": Optional(Number(0, 1), default=GLASS_REFLECTANCE),
    "raw_normal": Optional(VECTOR),
    "logit_reflectance": Optional(LOGIT),
    "transmittance": Optional(Items(Number(LEAST_TRANSMITTANCE, LARGEST_TRANSMITTANCE), 3)),
    "log_transmittance": Optional(Items(LOGIT, 3)),
}


def write_planes(path: Path | str, planes: Planes) -> None:
    """Writes planes as a JSON list, atomically; `read_planes` gives back the same float32 bits.

    Each entry has label, mirror, center, normal (unit), tangent, half_sizes and base_reflectance for people
    and other programs (world units, the capture's frame), and the raw values raw_normal and
    logit_reflectance that training continues from; where glass may be tinted also transmittance, of red, green and
    blue, and its raw log_transmittance (see `Planes`).

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

    A file edited by hand works as expected: where `normal`, `base_reflectance` or `transmittance` no longer agrees
    with its raw value, or the raw value is missing, the readable one is taken.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not a list of planes, a missing or malformed value, or a label that appears twice.
    """
    path = Path(path)
    entries = [_checked_entry(entry, index, path) for index, entry in enumerate(_load_entries(path), start=1)]
    if not entries:
        return Planes.empty()
    labels = tuple(entry["label"] for entry in entries)
    if len(set(labels)) != len(labels):
        raise ValueError(f"{path} has plane labels {list(labels)}; expected every label once")
    return Planes(
        centers=_column(entries, "center"),
        raw_normals=torch.stack([_raw_normal(entry) for entry in entries]),
        logit_reflectances=torch.stack([_logit_reflectance(entry) for entry in entries]),
        tangents=_column(entries, "tangent"),
        half_sizes=_column(entries, "half_sizes"),
        labels=labels,
        mirrors=tuple(entry["label"] for entry in entries if entry["mirror"]),
        log_transmittances=_log_transmittances(entries),
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
    } | {name: values[index].tolist() for name, values in _glass(planes).items()}


def _glass(planes: Planes) -> dict[str, Tensor]:
    """What panes have if their glass may be tinted, a row for each."""
    glass = {}
    if planes.transmittances is not None and planes.log_transmittances is not None:
        glass["transmittance"] = planes.transmittances.clamp(LEAST_TRANSMITTANCE, LARGEST_TRANSMITTANCE)
        glass["log_transmittance"] = planes.log_transmittances
    return glass


def _finite(value: Any) -> bool:
    return all(_finite(one) for one in value) if isinstance(value, list) else math.isfinite(value)


def _load_entries(path: Path) -> list[Any]:
    if not os.path.isfile(path):
        raise FileNotFoundError(f"no planes file at {path}; expected the planes.json of a run")
    entries = read_json(path)
    if not isinstance(entries, list):
        raise ValueError(f"{path} holds {shown(entries)}; expected a list with one object per plane")
    return entries


def _checked_entry(entry: Any, index: int, path: Path) -> dict[str, Any]:
    """One plane whose rectangle has a direction and an area."""
    where = f"plane {index} in {path}"
    plane = checked(entry, PLANE, where)
    normal, tangent = (torch.tensor(plane[key], dtype=torch.float64) for key in ("normal", "tangent"))
    for key, vector in (("normal", normal), ("tangent", tangent)):
        if float(vector.norm()) < LEAST_LENGTH:
            raise ValueError(f"{key} of {where} has length 0; expected a direction")
    if float(torch.linalg.cross(normal, tangent).norm() / (normal.norm() * tangent.norm())) < LEAST_ANGLE:
        raise ValueError(f"tangent of {where} lies along its normal; expected the direction of a side of the rectangle")
    return plane


def _column(entries: list[dict[str, Any]], key: str) -> Tensor:
    return torch.tensor([entry[key] for entry in entries], dtype=torch.float32)


def _raw_normal(entry: Mapping[str, Any]) -> Tensor:
    normal = torch.tensor(entry["normal"], dtype=torch.float32)
    if entry["raw_normal"] is None:
        return normal
    raw = torch.tensor(entry["raw_normal"], dtype=torch.float32)
    unit, raw_unit = (torch.nn.functional.normalize(vector, dim=0) for vector in (normal, raw))
    return raw if (unit - raw_unit).abs().max() <= EDIT_TOLERANCE else normal


def _logit_reflectance(entry: Mapping[str, Any]) -> Tensor:
    readable = torch.tensor(entry["base_reflectance"], dtype=torch.float32)
    if entry["logit_reflectance"] is not None:
        logit = torch.tensor(entry["logit_reflectance"], dtype=torch.float32)
        if (torch.sigmoid(logit) - readable).abs() <= EDIT_TOLERANCE:
            return logit
    return torch.logit(readable, eps=REFLECTANCE_MARGIN)


def _log_transmittances(entries: list[dict[str, Any]]) -> Tensor | None:
    """[K, 3], zeros for panes that say nothing of it; None if none does."""
    if all(entry["transmittance"] is None for entry in entries):
        return None
    return torch.stack([_log_transmittance(entry) for entry in entries])


def _log_transmittance(entry: Mapping[str, Any]) -> Tensor:
    readable = torch.tensor(entry["transmittance"] or (1.0, 1.0, 1.0), dtype=torch.float32)
    if entry["log_transmittance"] is not None:
        raw = torch.tensor(entry["log_transmittance"], dtype=torch.float32)
        if (raw.exp() - readable).abs().max() <= EDIT_TOLERANCE:
            return raw
    return readable.log()
