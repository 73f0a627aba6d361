"""Run directories that are damaged or were modified by users."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from glassplat.cli.runs import open_run
from glassplat.errors import InputError
from glassplat.files.ply import write_gaussians
from glassplat.methods.glossy_recipes import DeferredRecipe
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.recipe import recipe_to_json
from glassplat.model.run_directory import RunDirectory
from glassplat.scene.scene import Scene
from tests.cli.tiny_run import write_run
from tests.training.tiny_capture import true_scene

SCENE = "point_cloud/iteration_1"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run")


def edit(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_copies_of_a_scene_under_other_names_are_kept(run: Path) -> None:
    for name in ("iteration_abc", "iteration_1 (copy)", "iteration_-3", "iteration_2.5", "iteration_1_old", "best"):
        shutil.copytree(run / SCENE, run / "point_cloud" / name)
    (run / "point_cloud/iteration_7").write_text("a file")
    assert RunDirectory(run).latest_scene()[1] == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("null", "scene.json is None; expected an object with extent"),
        ("[]", r"scene.json is \[\]; expected an object with extent"),
        ("{}", "scene.json has no extent; expected a finite number above 1e-12"),
        ("", "scene.json is not valid JSON"),
        ("[" * 10**5, "scene.json is nested more than"),
        (
            '{"extent": NaN, "active_sh_degree": 0}',
            "extent of .*scene.json is nan; expected a finite number above 1e-12",
        ),
        ('{"extent": -1, "active_sh_degree": 0}', "extent of .*scene.json is -1; expected a finite number above 1e-12"),
        ('{"extent": "1", "active_sh_degree": 0}', "extent of .*scene.json is '1'; expected a finite number"),
        ('{"extent": 1, "active_sh_degree": 1.5}', "active_sh_degree of .*scene.json is 1.5; expected a whole number"),
        ('{"extent": 1, "active_sh_degree": 3}', r"scene.json and .*point_cloud.ply do not belong together: active_sh"),
        ('{"extent": 1, "active_sh_degree": 0, "files": ["../x"]}', "entry 1 of files of .* expected one of"),
    ],
)
def test_a_damaged_scene_header_is_named(run: Path, content: str, message: str) -> None:
    (run / SCENE / "scene.json").write_text(content)
    with pytest.raises(InputError, match=message):
        RunDirectory(run).latest_scene()


@pytest.mark.parametrize("name", ["scene.json", "point_cloud.ply", "glass.ply", "planes.json"])
@pytest.mark.parametrize("damage", ["missing", "folder"])
def test_a_missing_file_of_a_scene_is_named(run: Path, name: str, damage: str) -> None:
    (run / SCENE / name).unlink()
    if damage == "folder":
        (run / SCENE / name).mkdir()
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        RunDirectory(run).latest_scene()


def test_a_run_without_a_scene_is_resumed_only_from_a_checkpoint(run: Path) -> None:
    shutil.rmtree(run / SCENE)
    with pytest.raises(InputError, match=r"expected a finished run\. Nothing was saved yet: train it again$"):
        RunDirectory(run).latest_scene()
    RunDirectory(run).checkpoint.write_bytes(b"")
    with pytest.raises(InputError, match=r"a finished run\. Finish it with `glassplat train \.\.\. --resume`$"):
        RunDirectory(run).latest_scene()


def test_glass_without_marks_is_named(run: Path) -> None:
    glass = true_scene().glass
    bare = type(glass)(**{name: t for name, t in glass.tensors().items() if name != "logit_mark"})
    write_gaussians(run / SCENE / "glass.ply", bare)
    with pytest.raises(InputError, match=r"glass\.ply has no property logit_mark"):
        RunDirectory(run).latest_scene()


def test_glass_of_discs_is_named(run: Path) -> None:
    glass = true_scene().glass
    write_gaussians(run / SCENE / "glass.ply", replace(glass, log_scales=glass.log_scales[:, :2]))
    with pytest.raises(InputError, match=r"glass\.ply has two scales, scale_0 and scale_1; expected three"):
        RunDirectory(run).latest_scene()


@pytest.mark.parametrize(
    ("recipe", "message"),
    [
        (DeferredRecipe(), "the scene has no environment; expected one trained with `deferred`"),
        (PlanarRecipe(), "expected log_intensity, as `planar` trains it"),
    ],
)
def test_a_scene_of_another_method_is_refused_when_it_is_opened(run: Path, recipe: Any, message: str) -> None:
    scene = true_scene()
    primary = scene.primary
    bare = type(primary)(**{n: t for n, t in primary.tensors().items() if n != "log_intensity"})
    RunDirectory(run).export(Scene(bare, scene.extent, scene.glass, scene.planes), step=2)
    (run / "recipe.json").write_text(recipe_to_json(recipe))
    with pytest.raises(InputError, match=message):
        open_run(run, "cpu")


def test_a_scene_without_colours_is_refused_when_it_is_opened(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", planar=False)
    primary = true_scene().primary
    grey = replace(primary, sh=primary.sh[:, :0], active_sh_degree=0)
    RunDirectory(run).export(Scene(grey, 1.0), step=2)
    with pytest.raises(InputError, match="the Gaussians have no colours"):
        open_run(run, "cpu")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data": 3}, "data is 3; expected a text"),
        ({"iterations": "many"}, "iterations is 'many'; expected a whole number from 1"),
        ({"iterations": 0}, "iterations is 0; expected a whole number from 1"),
        ({"downscale": 0.5}, "downscale is 0.5; expected a number from 1"),
        ({"downscale": 10**400}, "downscale is inf; expected a number from 1"),
        ({"seed": 1.5}, "seed is 1.5; expected a whole number"),
        ({"device": []}, r"device is \[\]; expected a text"),
        ({"mask_polarity": "grey"}, "mask_polarity is 'grey'; expected one of auto, bright, dark"),
    ],
)
def test_damaged_settings_are_named(run: Path, changes: dict[str, Any], message: str) -> None:
    edit(run / "settings.json", **changes)
    with pytest.raises(InputError, match=rf"settings\.json cannot be read: {message}"):
        RunDirectory(run).settings()


@pytest.mark.parametrize("content", [b"", b"[]", b"null", b"{}", b"\xff\xfe", b"[" * 10**5])
def test_invalid_settings_are_named(run: Path, content: bytes) -> None:
    (run / "settings.json").write_bytes(content)
    with pytest.raises(InputError, match=r"settings\.json"):
        RunDirectory(run).settings()


def test_settings_of_an_earlier_version_have_defaults(run: Path) -> None:
    (run / "settings.json").write_text('{"data": "somewhere", "iterations": 3}')
    settings = RunDirectory(run).settings()
    assert (settings.downscale, settings.seed, settings.device, settings.mask_polarity) == (1.0, 0, "cpu", "auto")
