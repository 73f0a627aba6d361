import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.files.scene_folder import read_scene, write_scene
from glassplat.files.sidecars import read_equirect
from glassplat.model.run_directory import RunDirectory
from glassplat.render.deferred import equirect_from_environment
from glassplat.scene.scene import Environment, Scene
from tests.render.tiny_scene import in_single_precision, showcase


def lit(size: int = 3) -> Environment:
    raw = Environment.random(size, generator=torch.Generator().manual_seed(0)).raw
    return Environment(raw, (1.0, 2.0, 3.0, 0.25))


@pytest.mark.parametrize("panes", [False, True])
@pytest.mark.parametrize("environment", [Environment.empty(), lit()])
def test_a_scene_round_trips_bit_for_bit(tmp_path: Path, panes: bool, environment: Environment) -> None:
    whole = in_single_precision(showcase())
    scene = replace(whole if panes else Scene(whole.primary, whole.extent), environment=environment)
    write_scene(tmp_path, scene)
    read = read_scene(tmp_path)
    assert read.extent == scene.extent and read.environment.region == environment.region
    assert read.primary.active_sh_degree == scene.primary.active_sh_degree
    assert read.parameters().keys() == scene.parameters().keys()
    for name, tensor in scene.parameters().items():
        assert torch.equal(read.parameters()[name], tensor), name
    assert (tmp_path / "environment.safetensors").is_file() != environment.is_empty


def test_a_scene_does_not_take_over_what_an_earlier_one_left(tmp_path: Path) -> None:
    whole = replace(in_single_precision(showcase()), environment=lit())
    write_scene(tmp_path, whole)
    write_scene(tmp_path, Scene(whole.primary, whole.extent))
    bare = read_scene(tmp_path)
    assert not len(bare.planes) and not len(bare.glass) and bare.environment.is_empty


def surrounded() -> Scene:
    """A scene whose surroundings use fewer SH coefficients than they store."""
    scene = in_single_precision(showcase())
    around = replace(scene.primary, channels={}, active_sh_degree=0)
    return replace(Scene(scene.primary, scene.extent), surroundings=around.select(torch.arange(0, len(around), 2)))


def test_surroundings_round_trip_bit_for_bit(tmp_path: Path) -> None:
    scene = surrounded()
    write_scene(tmp_path, scene)
    read = read_scene(tmp_path)
    assert read.parameters().keys() == scene.parameters().keys()
    assert all(torch.equal(read.parameters()[name], tensor) for name, tensor in scene.parameters().items())
    assert read.surroundings.active_sh_degree == 0 < read.primary.active_sh_degree
    assert not read.surroundings.channels


def test_lost_or_foreign_surroundings_are_reported(tmp_path: Path) -> None:
    write_scene(tmp_path, surrounded())
    header = json.loads((tmp_path / "scene.json").read_text())
    (tmp_path / "scene.json").write_text(json.dumps(header | {"surroundings_sh_degree": 3}))
    with pytest.raises(ValueError, match=r"scene\.json and .*surroundings\.ply do not belong together"):
        read_scene(tmp_path)
    (tmp_path / "surroundings.ply").unlink()
    with pytest.raises(FileNotFoundError, match=r"no surroundings\.ply in .*; scene\.json says that the scene has one"):
        read_scene(tmp_path)


def test_a_damaged_environment_is_named(tmp_path: Path) -> None:
    write_scene(tmp_path, replace(in_single_precision(showcase()), environment=lit()))
    (tmp_path / "environment.safetensors").write_bytes(b"cut")
    with pytest.raises(ValueError, match=r"environment\.safetensors is truncated or not an environment"):
        read_scene(tmp_path)


def test_an_exported_environment_can_be_viewed(tmp_path: Path) -> None:
    scene = replace(in_single_precision(showcase()), environment=lit(4))
    folder = RunDirectory(tmp_path).export(scene, step=7)
    shown = read_equirect(folder / "environment.png")
    torch.testing.assert_close(shown, equirect_from_environment(scene.environment, 8), atol=0.5 / 255 + 1e-6, rtol=0)
    assert torch.equal(RunDirectory(tmp_path).latest_scene()[0].environment.raw, scene.environment.raw)
    bare = RunDirectory(tmp_path).export(replace(scene, environment=Environment.empty()), step=8)
    assert not (bare / "environment.png").exists()


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [("point_cloud", "sh", torch.nan), ("point_cloud", "log_intensity", 100.0), ("glass", "logit_mark", torch.inf)],
)
def test_values_too_large_for_rendering_are_named(tmp_path: Path, part: str, name: str, value: float) -> None:
    scene = in_single_precision(showcase())
    gaussians = scene.primary if part == "point_cloud" else scene.glass
    broken = gaussians.tensors()[name].clone()
    broken[1] = value
    changed = gaussians.with_tensors({name: broken})
    write_scene(tmp_path, replace(scene, **{"primary" if part == "point_cloud" else "glass": changed}))
    with pytest.raises(ValueError, match=rf"{part}\.ply holds the value {value:g} of {name}; expected at most"):
        read_scene(tmp_path)
