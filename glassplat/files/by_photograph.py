"""A small tensor for each photograph, as readable JSON by its name."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from glassplat.files.atomic import atomic_write
from glassplat.files.fields import ByName, Field
from glassplat.files.json_text import read_json


def write_by_photograph(path: Path, names: Sequence[str], values: Tensor) -> None:
    """Writes values [N, ...] of N photographs; `read_by_photograph` returns them exactly."""
    entries = dict(zip(names, values.detach().cpu().tolist(), strict=True))
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")


def read_by_photograph(path: Path, entry: Field, shape: tuple[int, ...]) -> tuple[tuple[str, ...], Tensor]:
    """Names of N photographs and the float32 values [N, *shape] that `write_by_photograph` wrote.

    Args:
        path: the file.
        entry: what the value of each photograph has to be; as nested lists, of `shape`.
        shape: of one value.

    Raises:
        FileNotFoundError, ValueError: the file is missing or foreign; says what is wrong.
    """
    entries = ByName(entry).read(read_json(path), str(path))
    return tuple(entries), torch.tensor(list(entries.values()), dtype=torch.float32).reshape(len(entries), *shape)
