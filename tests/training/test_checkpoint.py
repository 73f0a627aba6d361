"""Checkpoints that are damaged or belong to another run."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from glassplat.errors import InputError
from glassplat.training.checkpoint import load_checkpoint, read_progress, save_checkpoint
from glassplat.training.densify import ScreenStatistics
from glassplat.training.stage import Optimizer, TrainState
from tests.files.test_tensors_file import no_file_beyond
from tests.training.tiny_capture import true_scene


def trained_state() -> TrainState:
    """A state with everything that a checkpoint can hold."""
    scene = true_scene()
    parameters = scene.parameters()
    return TrainState(
        scene,
        seed=3,
        step=7,
        optimizer=Optimizer(
            {name: (torch.zeros_like(t), torch.ones_like(t)) for name, t in parameters.items()},
            updates=dict.fromkeys(parameters, 7),
        ),
        statistics={"primary": ScreenStatistics.zeros(len(scene.primary))},
        seconds=1.5,
        records={"grew": 4.0},
        means={name: t.clone() for name, t in parameters.items()},
        method="planar",
    )


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    save_checkpoint(tmp_path / "checkpoint.safetensors", trained_state())
    return tmp_path / "checkpoint.safetensors"


def rewrite(path: Path, edit: Callable[[dict[str, Any], dict[str, Tensor]], None]) -> None:
    """Changes header and tensors of a checkpoint."""
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["glassplat"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    edit(header, tensors)
    save_file(tensors, path, metadata={"glassplat": json.dumps(header)})


def test_a_state_round_trips(checkpoint: Path) -> None:
    written, read = trained_state(), load_checkpoint(checkpoint)
    for key in ("method", "seed", "step", "seconds", "records"):
        assert getattr(read, key) == getattr(written, key), key
    assert read.optimizer.updates == written.optimizer.updates
    for name, tensor in written.scene.parameters().items():
        assert torch.equal(read.scene.parameters()[name], tensor), name
        assert torch.equal(read.means[name], tensor), name
        assert torch.equal(read.optimizer.moments[name][1], torch.ones_like(tensor)), name


def test_a_loaded_state_does_not_depend_on_its_file(checkpoint: Path) -> None:
    written, read = trained_state().scene.parameters(), load_checkpoint(checkpoint).scene.parameters()
    with checkpoint.open("r+b") as file:
        file.write(bytes(checkpoint.stat().st_size))
    assert all(torch.equal(read[name], tensor) for name, tensor in written.items())


def test_tinted_panes_round_trip(tmp_path: Path) -> None:
    state, tint = trained_state(), -torch.rand(1, 3)
    state.scene = replace(state.scene, planes=replace(state.scene.planes, log_transmittances=tint))
    save_checkpoint(tmp_path / "checkpoint.safetensors", state)
    assert torch.equal(
        load_checkpoint(tmp_path / "checkpoint.safetensors").scene.planes.tensors()["log_transmittances"], tint
    )


def test_surroundings_round_trip(tmp_path: Path) -> None:
    scene = true_scene()
    around = replace(scene.primary, channels={}, active_sh_degree=0)
    save_checkpoint(tmp_path / "checkpoint", TrainState(replace(scene, surroundings=around), seed=3))
    read = load_checkpoint(tmp_path / "checkpoint").scene
    assert read.surroundings.active_sh_degree == 0 and torch.equal(read.surroundings.sh, around.sh)
    assert read.parameters().keys() > scene.parameters().keys()


def test_a_full_disk_leaves_the_older_checkpoint(checkpoint: Path) -> None:
    before = checkpoint.read_bytes()
    with no_file_beyond(4000), pytest.raises(OSError, match="the previous contents are unchanged"):
        save_checkpoint(checkpoint, trained_state())
    assert checkpoint.read_bytes() == before


HEADERS: list[tuple[dict[str, Any], str]] = [
    ({"step": None}, "step of the header of .* is None; expected a whole number of at least 0"),
    ({"seed": "zero"}, "seed of the header of .* is 'zero'; expected a whole number"),
    ({"seconds": "long"}, "seconds of the header of .* is 'long'; expected a finite number"),
    ({"extent": 0}, "extent of the header of .* is 0; expected a finite number above 1e-12"),
    ({"labels": 5}, "labels of the header of .* is 5; expected a list"),
    ({"labels": ["left"]}, "entry 1 of labels of the header of .* is 'left'; expected a whole number"),
    ({"step": -5}, "step of the header of .* is -5; expected a whole number of at least 0"),
    ({"step": 2.5}, "step of the header of .* is 2.5; expected a whole number"),
    ({"extent": 1e-300}, "extent of the header of .* is 1e-300; expected a finite number above 1e-12"),
    ({"extent": float("nan")}, "extent of the header of .* is nan; expected a finite number"),
    ({"labels": [1, 2, 3]}, r"holds no training state: planes: centers has shape \(1, 3\); expected \(3, 3\)"),
    ({"mirrors": [9]}, "holds no training state: planes: mirrors .* are not all among the plane labels"),
    ({"region": [1]}, "region of the header of .* is .*; expected a list of 4 values"),
    ({"active_sh_degree": 1}, "active_sh_degree of the header of .* is 1; expected an object"),
    ({"active_sh_degree": {}}, "holds no training state: it holds the sets of Gaussians"),
    ({"active_sh_degree": {"primary": 3, "glass": 0}}, "holds no training state: primary: active_sh_degree is 3"),
    ({"active_sh_degree": {"primary": 1.5, "glass": 0}}, "'primary' of active_sh_degree of .* is 1.5"),
    ({"updates": [1]}, "updates of the header of .* expected an object"),
    ({"updates": {}}, "not every parameter that was stepped has both moments and a count"),
    ({"paused": {"primary.means": "yes"}}, "'primary.means' of paused of .* is 'yes'; expected a whole number"),
    ({"records": [2]}, "records of the header of .* expected an object"),
    ({"method": 4}, "method of the header of .* is 4; expected a text"),
    ({"format": "glassplat-checkpoint-9"}, "has format 'glassplat-checkpoint-9'; expected 'glassplat-checkpoint-1'"),
]


@pytest.mark.parametrize(("change", "message"), HEADERS)
def test_a_damaged_header_is_named(checkpoint: Path, change: dict[str, Any], message: str) -> None:
    rewrite(checkpoint, lambda header, _: header.update(change))
    with pytest.raises(InputError, match=message) as caught:
        load_checkpoint(checkpoint)
    assert str(checkpoint) in str(caught.value)


NEEDED = ["step", "seed", "seconds", "extent", "labels", "active_sh_degree", "updates"]


@pytest.mark.parametrize("key", NEEDED)
def test_fields_missing_from_the_header_are_named(checkpoint: Path, key: str) -> None:
    rewrite(checkpoint, lambda header, _: header.pop(key))
    with pytest.raises(InputError, match=f"the header of .* has no {key}; expected"):
        read_progress(checkpoint)


TENSORS: list[tuple[str, Any, str]] = [
    ("scene/primary/means", None, r"primary has the tensors \[.*\]; expected \[.*'means'"),
    (
        "scene/primary/means",
        torch.zeros(4, 3),
        r"primary: quats has .*; expected \(4, 4\), as many rows in all tensors",
    ),
    ("scene/primary/quats", torch.zeros(40, 3), r"primary: quats has shape \(40, 3\); expected \(30, 4\)"),
    ("scene/primary/sh", torch.zeros(40, 2, 3), r"primary: sh has shape \(40, 2, 3\)"),
    ("scene/primary/means", torch.zeros(40, 3, dtype=torch.int64), "holds torch.int64; expected floating-point"),
    ("scene/primary/means", torch.zeros(40, 3, dtype=torch.float64), "expected one precision"),
    ("scene/glass/logit_mark", torch.zeros(()), r"glass: logit_mark has shape \(\)"),
    ("scene/planes/tangents", None, r"planes has the tensors .*; expected .*'tangents'"),
    ("scene/planes/normals", torch.zeros(1, 3), r"planes has the tensors .*'normals'.*; expected"),
    ("scene/environment/texels", torch.zeros(6, 1, 1, 3), r"environment has the tensors \['texels'\]; expected"),
    ("scene/environment/raw", torch.zeros(3), r"environment: raw has shape \(3,\); expected \(6, S, S, 3\)"),
    ("scene/glass/logit_mark", None, "the glass has no logit_mark"),
    ("scene/primary/log_intensity", None, "it has moments of primary.log_intensity, but no such parameters"),
    ("second/primary.means", None, "has both moments"),
    ("second/primary.means", torch.zeros(2, 3), r"primary.means of the second moments has shape \[2, 3\]; expected"),
    ("statistics/primary/view_count", None, "the statistics of primary are"),
    ("statistics/primary/view_count", torch.zeros(2, 1), r"view_count of the statistics of primary has shape \[2, 1\]"),
    ("statistics/other/view_count", torch.zeros(2, 1), "it holds statistics of other; expected those of primary"),
]


@pytest.mark.parametrize(("name", "tensor", "message"), TENSORS)
def test_tensors_that_form_no_state_are_named(checkpoint: Path, name: str, tensor: Any, message: str) -> None:
    def edit(_: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        tensors.pop(name) if tensor is None else tensors.update({name: tensor})

    rewrite(checkpoint, edit)
    with pytest.raises(InputError, match=message) as caught:
        load_checkpoint(checkpoint)
    assert f"{checkpoint} holds no training state" in str(caught.value)


def test_a_checkpoint_of_an_earlier_version_is_read(checkpoint: Path) -> None:
    def edit(header: dict[str, Any], _: dict[str, Tensor]) -> None:
        for key in ("method", "mirrors", "region", "paused", "records"):
            del header[key]

    rewrite(checkpoint, edit)
    assert load_checkpoint(checkpoint, method="planar", seed=3, iterations=7).records == {}
