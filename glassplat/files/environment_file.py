"""An environment beside the PLY: the raw texels of its cube map, exactly as trained."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from glassplat.files.atomic import atomic_write
from glassplat.scene.environment import Environment

FORMAT = "glassplat-environment-1"


def write_environment(path: Path | str, environment: Environment) -> None:
    """Writes an environment, atomically; `read_environment` gives back the same bits.

    Raises:
        OSError: the file cannot be written; an older one is unchanged.
    """
    header = {"format": FORMAT, "region": environment.region}
    with atomic_write(path) as temporary:
        raw = environment.raw.detach().cpu().contiguous()
        save_file({"raw": raw}, temporary, metadata={"glassplat": json.dumps(header)})


def read_environment(path: Path | str) -> Environment:
    """Reads what `write_environment` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated or foreign.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no environment at {path}; expected the environment.safetensors of a run")
    header, raw = _read(path)
    if header.get("format") != FORMAT or raw is None:
        raise ValueError(
            f"{path} has format {header.get('format')!r}; expected {FORMAT!r}, as glassplat's training writes it"
        )
    region = header.get("region")
    try:
        return Environment(raw, None if region is None else _sphere(region))
    except ValueError as error:
        raise ValueError(f"{path} holds no environment: {error}") from error


def _read(path: Path) -> tuple[dict[str, Any], Tensor | None]:
    """Header and raw texels; an empty header or None where the file has none."""
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("glassplat", "{}"))
            raw = file.get_tensor("raw") if "raw" in file.keys() else None  # noqa: SIM118
    except (SafetensorError, ValueError) as error:
        raise ValueError(
            f"{path} is truncated or no environment ({error}); restore it or export the run again"
        ) from error
    return header if isinstance(header, dict) else {}, raw


def _sphere(region: Any) -> tuple[float, float, float, float]:
    if not isinstance(region, list) or len(region) != 4 or not all(isinstance(value, (int, float)) for value in region):
        raise ValueError(f"its region is {region!r}; expected centre and radius, 4 numbers")
    x, y, z, radius = (float(value) for value in region)
    return x, y, z, radius
