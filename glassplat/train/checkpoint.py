"""Checkpoints: every tensor of a training state in one safetensors file, no pickle."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from glassplat.data.errors import InputError
from glassplat.densify.default import ScreenStatistics
from glassplat.files.atomic import atomic_write
from glassplat.scene.environment import Environment
from glassplat.scene.gaussians import PER_GAUSSIAN, Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.scene import Scene
from glassplat.train.optimizer import Optimizer
from glassplat.train.state import TrainState

FORMAT = "glassplat-checkpoint-1"


def save_checkpoint(path: Path, state: TrainState) -> None:
    """Writes `state` so that training goes on from it with the same result; atomic.

    Raises:
        OSError: the disk is full or not writable; an older file at `path` stays as it was.
    """
    scene = state.scene
    tensors: dict[str, Tensor] = {}
    for part, gaussians in scene.gaussian_sets().items():
        tensors |= {f"scene/{part}/{name}": t for name, t in gaussians.tensors().items()}
    tensors |= {f"scene/planes/{name}": t for name, t in scene.planes.tensors().items()}
    if not scene.environment.is_empty:
        tensors |= {f"scene/environment/{name}": t for name, t in scene.environment.tensors().items()}
    for name, (first, second) in state.optimizer.moments.items():
        tensors |= {f"first/{name}": first, f"second/{name}": second}
    for part, statistics in state.statistics.items():
        tensors |= {f"statistics/{part}/{name}": t for name, t in vars(statistics).items()}
    tensors |= {f"means/{name}": mean for name, mean in state.means.items()}
    header = {
        "format": FORMAT,
        "step": state.step,
        "seed": state.seed,
        "seconds": state.seconds,
        "extent": scene.extent,
        "labels": list(scene.planes.labels),
        "mirrors": list(scene.planes.mirrors),
        "region": scene.environment.region,
        "active_sh_degree": {part: g.active_sh_degree for part, g in scene.gaussian_sets().items()},
        "updates": state.optimizer.updates,
        "paused": state.optimizer.paused,
        "hurried": state.optimizer.hurried,
        "records": state.records,
    }
    with atomic_write(path) as temporary:
        owned = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}
        save_file(owned, temporary, metadata={"glassplat": json.dumps(header)})


def load_checkpoint(path: Path) -> TrainState:
    """Reads what `save_checkpoint` wrote.

    Raises:
        InputError: the file is truncated, or is no checkpoint of glassplat.
        FileNotFoundError: there is no such file.
    """
    with opened_checkpoint(path) as (header, file):
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    return restored_state(header, tensors)


def recorded_seconds(path: Path) -> float:
    """Training time up to a checkpoint; reads its header and no tensor, so it costs nothing.

    Raises:
        InputError: the file is truncated, or is no checkpoint of glassplat.
        FileNotFoundError: there is no such file.
    """
    with opened_checkpoint(path) as (header, _):
        return float(header["seconds"])


@contextmanager
def opened_checkpoint(path: Path) -> Iterator[tuple[dict, Any]]:
    """The header of a checkpoint, checked, and the open file that its tensors can be read from."""
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}; expected the file that training writes there")
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("glassplat", "{}"))
            if header.get("format") == FORMAT:
                yield header, file
                return
    except (SafetensorError, ValueError) as error:
        raise InputError(
            f"{path} is truncated or not a checkpoint ({error}); use an older one or train again"
        ) from error
    raise InputError(
        f"{path} has format {header.get('format')!r}; expected {FORMAT!r}, as glassplat's training writes it"
    )


def restored_state(header: dict, tensors: dict[str, Tensor]) -> TrainState:
    """The training state of a checkpoint's header and tensors."""
    sets = {
        part: restored_gaussians(under(tensors, f"scene/{part}/"), degree)
        for part, degree in header["active_sh_degree"].items()
    }
    planes = Planes(
        **under(tensors, "scene/planes/"), labels=tuple(header["labels"]), mirrors=tuple(header.get("mirrors", ()))
    )
    distant = under(tensors, "scene/environment/")
    region = tuple(header["region"]) if header.get("region") else None
    first, second = under(tensors, "first/"), under(tensors, "second/")
    statistics = under(tensors, "statistics/")
    parts = {name.partition("/")[0] for name in statistics}
    return TrainState(
        scene=Scene(
            extent=header["extent"],
            planes=planes,
            environment=Environment(**distant, region=region) if distant else Environment.empty(),
            **sets,
        ),
        seed=header["seed"],
        step=header["step"],
        seconds=header["seconds"],
        records=dict(header.get("records", {})),
        optimizer=Optimizer(
            {name: (first[name], second[name]) for name in first},
            updates=dict(header["updates"]),
            paused=dict(header.get("paused", {})),
            hurried=dict(header.get("hurried", {})),
        ),
        statistics={part: ScreenStatistics(**under(statistics, f"{part}/")) for part in sorted(parts)},
        means=under(tensors, "means/"),
    )


def restored_gaussians(tensors: dict[str, Tensor], active_sh_degree: int) -> Gaussians:
    """A set of Gaussians from its named tensors."""
    channels = {name: t for name, t in tensors.items() if name not in PER_GAUSSIAN}
    main: dict[str, torch.Tensor] = {name: tensors[name] for name in PER_GAUSSIAN}
    return Gaussians(**main, channels=channels, active_sh_degree=active_sh_degree)


def under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose name begins with a prefix, which is cut off."""
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
