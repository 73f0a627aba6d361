"""An environment beside the PLY: the raw texels of its cube map, exactly as trained."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from glassplat.files.fields import COORDINATE, Items, Nullable, Optional, checked
from glassplat.files.tensors_file import opened_tensors, write_tensors
from glassplat.scene.environment import Environment

FORMAT = "glassplat-environment-1"
REGION = Nullable(Items(COORDINATE, 4))
"""Centre and radius of the sphere that holds all that mirrors the environment."""


def write_environment(path: Path | str, environment: Environment) -> None:
    """Writes an environment, atomically; `read_environment` gives back the same bits.

    Raises:
        OSError: the file cannot be written; an older one is unchanged.
    """
    write_tensors(path, environment.tensors(), {"format": FORMAT, "region": environment.region})


def read_environment(path: Path | str) -> Environment:
    """Reads what `write_environment` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated or foreign, or holds values that are not finite.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"no environment at {path}; expected the environment.safetensors of a run")
    with opened_tensors(path, FORMAT, "an environment") as file:
        region = checked(file.header, {"region": Optional(REGION)}, f"the header of {path}")["region"]
        raw = file.tensors().get("raw")
    if raw is None or not (raw.is_floating_point() and bool(torch.isfinite(raw).all())):
        raise ValueError(f"{path} holds no tensor `raw` of finite numbers; expected the texels of an environment")
    try:
        return Environment(raw, region)
    except ValueError as error:
        raise ValueError(f"{path} holds no environment: {error}") from error
