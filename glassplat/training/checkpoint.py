"""Checkpoints: every tensor of a training state in one safetensors file, no pickle."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from glassplat.errors import InputError, convert_to_input_error
from glassplat.files.records import DictOf, Field, Integer, ListOf, Nullable, Number, Optional, Text, check_fields
from glassplat.files.scene_folder import DIRECTION, EXTENT, SH_DEGREE, direction
from glassplat.files.sidecars import HIGHEST_LABEL, REGION, TensorsFile, open_tensors, write_tensors
from glassplat.scene.corrections import Exposures, PoseCorrections
from glassplat.scene.gaussians import PER_GAUSSIAN, Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import OPTIONAL_SETS, PARTS, Environment, Scene
from glassplat.training.densify import ScreenStatistics
from glassplat.training.stage import Optimizer, TrainState

FORMAT = "glassplat-checkpoint-1"
LABELS = ListOf(Integer(1, HIGHEST_LABEL))
HEADER: dict[str, Field] = {
    "method": Optional(Nullable(Text())),
    "step": Integer(0),
    "seed": Integer(),
    "seconds": Number(0),
    "extent": EXTENT,
    "labels": LABELS,
    "mirrors": Optional(LABELS, ()),
    "region": Optional(REGION),
    "active_sh_degree": DictOf(SH_DEGREE),
    "updates": DictOf(Integer(0)),
    "paused": Optional(DictOf(Integer(0)), {}),
    "raised_rates": Optional(DictOf(Number(0)), {}),
    "records": Optional(DictOf(Number()), {}),
    "photographs": Optional(ListOf(Text()), ()),
    "corrected": Optional(ListOf(Text()), ()),
    "up": Optional(DIRECTION),
}
"""`Optional` fields were added after the first checkpoints were written."""
TINT = "log_transmittances"
"""Tensor of tinted panes only."""


def save_checkpoint(path: Path, state: TrainState) -> None:
    """Writes `state` atomically, such that training continues from it with the same result.

    Raises:
        OSError: the disk is full or not writable; an older file at `path` is unchanged.
    """
    scene = state.scene
    tensors = {f"scene/{name.replace('.', '/', 1)}": tensor for name, tensor in scene.tensors().items()}
    for name, (first, second) in state.optimizer.moments.items():
        tensors |= {f"first/{name}": first, f"second/{name}": second}
    for part, statistics in state.statistics.items():
        tensors |= {f"statistics/{part}/{name}": t for name, t in statistics._asdict().items()}
    tensors |= {f"means/{name}": mean for name, mean in state.means.items()}
    header = {
        "format": FORMAT,
        "method": state.method,
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
        "raised_rates": state.optimizer.raised_rates,
        "records": state.records,
        "photographs": list(scene.exposures.names),
        "corrected": list(scene.poses.names),
        "up": scene.up,
    }
    write_tensors(path, tensors, header)


def load_checkpoint(
    path: Path, *, method: str | None = None, seed: int | None = None, iterations: int | None = None
) -> TrainState:
    """Reads what `save_checkpoint` wrote.

    Args:
        path: the file.
        method: method of the run to continue; None accepts any.
        seed: seed of the run; None accepts any.
        iterations: length of the run; None accepts any step.

    Raises:
        InputError: the file is truncated, not a checkpoint of glassplat, or one of another run.
        FileNotFoundError: the file does not exist.
    """
    with open_checkpoint(path) as file:
        state = restored_state(file.header, file.tensors())
    remedy = "put the run's own checkpoint there, or train again"
    if method and state.method and state.method != method:
        raise InputError(f"{path} is a checkpoint of {state.method}; expected one of {method}: {remedy}")
    if seed is not None and state.seed != seed:
        raise InputError(f"{path} is of a run with the seed {state.seed}; expected {seed}: {remedy}")
    if iterations is not None and state.step > iterations:
        raise InputError(f"{path} is of step {state.step}; expected one of at most {iterations}: {remedy}")
    return state


class CheckpointProgress(NamedTuple):
    """Step of a checkpoint, and the training time up to it in seconds."""

    step: int
    seconds: float


def read_progress(path: Path) -> CheckpointProgress:
    """Step and training time of a checkpoint; fast, because only the header is read.

    Raises:
        InputError: the file is truncated, or not a checkpoint of glassplat.
        FileNotFoundError: the file does not exist.
    """
    with open_checkpoint(path) as file:
        return CheckpointProgress(int(file.header["step"]), float(file.header["seconds"]))


@contextmanager
def open_checkpoint(path: Path) -> Iterator[TensorsFile]:
    """An open checkpoint with a checked header; errors in its contents name the file."""
    if not os.path.isfile(path):
        raise FileNotFoundError(f"no checkpoint at {path}; expected the file that training writes there")
    try:
        with open_tensors(path, FORMAT, "a checkpoint") as file:
            yield TensorsFile(check_fields(file.header, HEADER, f"the header of {path}"), file.file)
    except InputError as error:
        raise InputError(f"{path} holds no training state: {error}; use an older one or train again") from error
    except ValueError as error:
        raise InputError(f"{error}; use an older checkpoint or train again") from error


def restored_state(header: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> TrainState:
    """Training state from a checked header and tensors.

    Raises:
        InputError: the tensors do not match the header or each other.
    """
    for name, tensor in tensors.items():
        if not tensor.is_floating_point():
            raise InputError(f"{name} holds {tensor.dtype}; expected floating-point numbers")
        common = next(iter(tensors.values())).dtype
        if tensor.dtype != common:
            raise InputError(f"{name} holds {tensor.dtype}, other tensors {common}; expected one precision")
    scene = restored_scene(header, tensors)
    first, second = tensors_with_prefix(tensors, "first/"), tensors_with_prefix(tensors, "second/")
    if not first.keys() == second.keys() <= header["updates"].keys():
        raise InputError("not every parameter that was stepped has both moments and a count of its updates")
    check_like(second, first, "the second moments")
    unknown = sorted(first.keys() - scene.parameters().keys())
    if unknown:
        raise InputError(f"it has moments of {', '.join(unknown)}, but no such parameters")
    return TrainState(
        scene=scene,
        method=header["method"],
        seed=header["seed"],
        step=header["step"],
        seconds=header["seconds"],
        records=dict(header["records"]),
        optimizer=Optimizer(
            {name: (first[name], second[name]) for name in first},
            updates=dict(header["updates"]),
            paused=dict(header["paused"]),
            raised_rates=dict(header["raised_rates"]),
        ),
        statistics=restored_statistics(tensors_with_prefix(tensors, "statistics/"), scene),
        means=tensors_with_prefix(tensors, "means/"),
    )


def restored_scene(header: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Scene:
    """The scene.

    Raises:
        InputError: a part is missing, or has other tensors than it needs; its own checks name wrong shapes.
    """
    degrees = header["active_sh_degree"]
    if degrees.keys() - set(OPTIONAL_SETS) != {"primary", "glass"}:
        raise InputError(
            f"it holds the sets of Gaussians {sorted(degrees)}; expected primary, glass, and "
            f"{' and '.join(OPTIONAL_SETS)} where there are any"
        )
    if "scene/glass/logit_mark" not in tensors:
        raise InputError("the glass has no logit_mark")
    held = {part: tensors_with_prefix(tensors, f"scene/{part}/") for part in PARTS}
    parts: dict[str, Any] = {}
    for part, degree in degrees.items():
        channels = {name: tensor for name, tensor in held[part].items() if name not in PER_GAUSSIAN}
        main = {name: tensor for name, tensor in held[part].items() if name in PER_GAUSSIAN}
        check_names(main, PER_GAUSSIAN, part)
        with convert_to_input_error(part):
            parts[part] = Gaussians(**main, channels=channels, active_sh_degree=degree)
    check_names(held["planes"], {*Planes.empty().tensors(), *({TINT} & held["planes"].keys())}, "planes")
    with convert_to_input_error("planes"):
        parts["planes"] = Planes(**held["planes"], labels=header["labels"], mirrors=header["mirrors"])
    blank = Environment.empty().tensors()
    environment = held["environment"] or blank
    check_names(environment, blank, "environment")
    with convert_to_input_error("environment"):
        parts["environment"] = Environment(**environment, region=header["region"])
    for part, kind, names in (
        ("exposures", Exposures, header["photographs"]),
        ("poses", PoseCorrections, header["corrected"]),
    ):
        if held[part]:
            check_names(held[part], (kind.TENSOR,), part)
            with convert_to_input_error(part):
                parts[part] = kind(held[part][kind.TENSOR], tuple(names))
    with convert_to_input_error():
        return Scene(**parts, extent=header["extent"], up=direction(header["up"], "the header"))


def restored_statistics(tensors: Mapping[str, Tensor], scene: Scene) -> dict[str, ScreenStatistics]:
    """The statistics of the sets of Gaussians that have some."""
    found = {}
    for part in sorted({name.partition("/")[0] for name in tensors}):
        gaussians = scene.gaussian_sets().get(part)
        if gaussians is None:
            raise InputError(f"it holds statistics of {part}; expected those of {', '.join(scene.gaussian_sets())}")
        expected = ScreenStatistics.zeros(len(gaussians))._asdict()
        known = tensors_with_prefix(tensors, f"{part}/")
        check_like(known, expected, f"the statistics of {part}")
        if known.keys() != expected.keys():
            raise InputError(f"the statistics of {part} are {sorted(known)}; expected {sorted(expected)}")
        found[part] = ScreenStatistics(**known)
    return found


def check_names(tensors: Mapping[str, Tensor], names: Collection[str], owner: str) -> None:
    """Raises InputError unless the tensors have exactly these names."""
    if tensors.keys() != set(names):
        raise InputError(f"{owner} has the tensors {sorted(tensors)}; expected {sorted(names)}")


def check_like(tensors: Mapping[str, Tensor], examples: Mapping[str, Tensor], owner: str) -> None:
    """Raises InputError unless each tensor has the shape of the example of the same name."""
    for name, tensor in tensors.items():
        if name not in examples or tensor.shape != examples[name].shape:
            expected = list(examples[name].shape) if name in examples else "none of that name"
            raise InputError(f"{name} of {owner} has shape {list(tensor.shape)}; expected {expected}")


def tensors_with_prefix(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names have a prefix, without the prefix."""
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
