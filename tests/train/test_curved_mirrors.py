"""Curved mirrors among panes: when they begin, what is taken for one, how normals spread, a short run and resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.data.dataset import Dataset
from glassplat.data.errors import InputError
from glassplat.data.options import options_from_json
from glassplat.data.view import View
from glassplat.densify.options import DefaultDensify, MirrorSearch, NormalPropagation
from glassplat.densify.reflectors import residual_spreads
from glassplat.files.scene_folder import read_scene, write_scene
from glassplat.render.planar import Planar
from glassplat.scene.gaussians import Gaussians
from glassplat.train.checkpoint import load_checkpoint, save_checkpoint
from glassplat.train.curved_mirrors import RESHAPED, BeginCurved, SpreadMirrors, beside_mirrors
from glassplat.train.messages import ActionDone, Message, StageEntered, StepDone
from glassplat.train.mirror_options import CurvedMirrors, SurroundingsOptions, SurroundingsStart
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.recipe import recipe_from_json, recipe_to_json
from glassplat.train.rhythm import Rhythm
from glassplat.train.stage import Clock, Every
from glassplat.train.state import TrainState
from glassplat.train.trainer import train
from tests.densify.test_outlines import TRUE, cameras, surrounded
from tests.render.test_curved import CAMERA, glossy
from tests.render.tiny_scene import in_single_precision
from tests.train.tiny_capture import tiny_capture, true_scene

ITERATIONS = 40
CURVED = CurvedMirrors(
    learn=True,
    start=0.5,
    spread_until=0.8,
    beat=0.1,
    least_strength=0.0,
    first_strength=0.3,
    search=MirrorSearch(spread=1.0),
    surroundings=SurroundingsOptions(
        start=SurroundingsStart("both", cells=2),
        densify=DefaultDensify(
            split_by="gradient", interval=5, whole_passes=False, stop=0.9, gradient_threshold=1e-7,
            least_contribution=0.02, contribution_moments=(0.9,),
        ),
    ),
    texels=4,
    first_texels=2,
    refinements=(0.6, 0.7),
    region=(0.0, 0.0, 3.5, 1.0),
)  # fmt: skip
RECIPE = PlanarRecipe(
    sh_degree=1, detect_mirrors=False, seed_reflections=False, curved=CURVED, rhythm=Rhythm(beat=0.1, least=2, sh=0.1)
)


def paned_capture() -> Dataset:
    """The tiny capture, with its pane given."""
    return replace(tiny_capture(), planes=true_scene().planes)


def run(recipe: PlanarRecipe, state: TrainState, iterations: int = ITERATIONS) -> list[Message]:
    return list(train(recipe.stages(seed=0), paned_capture(), state, iterations))


def fresh_state(recipe: PlanarRecipe = RECIPE) -> TrainState:
    return TrainState(recipe.initialise(paned_capture()), seed=0)


def test_a_short_run_looks_for_panes_and_then_for_what_reflects() -> None:
    state = fresh_state()
    messages = run(RECIPE, state)
    entered = {m.stage: m.counts for m in messages if isinstance(m, StageEntered)}
    assert list(entered) == [
        "1 initialisation", "2 plane adjustment", "3 joint optimisation", "4 curved mirrors", "5 refinement",
    ]  # fmt: skip
    assert entered["3 joint optimisation"]["planes"] == 1 and "surroundings" not in entered["3 joint optimisation"]
    assert entered["4 curved mirrors"]["surroundings"] > 0
    assert next(m.step for m in messages if isinstance(m, StageEntered) and m.stage[0] == "4") == 20
    done = {m.action for m in messages if isinstance(m, ActionDone)}
    assert {"densify surroundings", "prune idle surroundings", "propagate normals", "refine environment"} <= done
    assert all(bool(torch.isfinite(tensor).all()) for tensor in state.scene.parameters().values())
    strengths = state.scene.primary.channels["logit_strength"]
    assert float(strengths.std()) > 1e-3
    losses = [m.losses for m in messages if isinstance(m, StepDone)]
    assert {"outside", "strength", "conflict"} <= losses[-1].keys() and "consistency" in losses[25]


def test_stages_make_up_the_whole_run_and_are_those_of_planar_without() -> None:
    plain, curved = PlanarRecipe().stages(0), PlanarRecipe(curved=CurvedMirrors(learn=True)).stages(0)
    assert sum(stage.share for stage in curved) == pytest.approx(1)
    assert [stage.share for stage in curved[:2]] == [stage.share for stage in plain[:2]]
    for stage in curved[:3]:
        assert not isinstance(stage.renderer, Planar) or stage.renderer.curved is None
        assert not any(name.startswith(("surroundings", "environment")) for name in stage.rates)
    for stage in curved[3:]:
        assert isinstance(stage.renderer, Planar) and stage.renderer.curved is not None
        # A strength learns from what it would reflect, however little that is.
        assert stage.renderer.curved.faintest == 0
        assert {"primary.logit_strength", "surroundings.means", "environment.raw"} <= stage.rates.keys()
    assert isinstance(curved[3].entry, BeginCurved) and curved[4].entry is None
    assert any(isinstance(action, SpreadMirrors) for action in curved[3].actions)
    assert not any(isinstance(action, SpreadMirrors) for action in curved[4].actions)
    finished = PlanarRecipe(curved=CurvedMirrors(learn=True)).renderer()
    assert finished.curved is not None and finished.curved.faintest > 0
    assert PlanarRecipe().renderer().curved is None


def test_curved_mirrors_do_not_begin_before_the_panes_are_known() -> None:
    stages = PlanarRecipe(curved=CurvedMirrors(learn=True, start=0.05)).stages(0)
    assert [stage.share for stage in stages[:3]] == pytest.approx([0.1, 0.1, 0.0])
    assert sum(stage.share for stage in stages) == pytest.approx(1)


def test_normals_need_time_to_spread() -> None:
    with pytest.raises(InputError, match="normals spread in between"):
        options_from_json(PlanarRecipe, {"curved": {"learn": True, "start": 0.4, "spread_until": 0.3}})


def test_the_recipe_survives_its_file() -> None:
    assert recipe_from_json(recipe_to_json(RECIPE)) == RECIPE


def test_a_run_that_is_taken_up_again_ends_as_one_that_was_not(tmp_path: Path) -> None:
    whole = fresh_state()
    run(RECIPE, whole)
    half = fresh_state()
    for message in train(RECIPE.stages(seed=0), paned_capture(), half, ITERATIONS):
        if isinstance(message, StepDone) and message.step == 27:
            break
    save_checkpoint(tmp_path / "checkpoint.safetensors", half)
    again = load_checkpoint(tmp_path / "checkpoint.safetensors")
    run(RECIPE, again)
    expected = whole.scene.parameters()
    assert again.scene.parameters().keys() == expected.keys()
    for name, tensor in again.scene.parameters().items():
        assert torch.equal(tensor, expected[name]), name


def test_panes_surroundings_and_environment_are_stored_together(tmp_path: Path) -> None:
    scene = in_single_precision(glossy())
    scene = replace(scene, environment=replace(scene.environment, raw=scene.environment.raw.float()))
    write_scene(tmp_path / "scene", scene)
    stored = read_scene(tmp_path / "scene")
    assert stored.parameters().keys() == scene.parameters().keys()
    for name, tensor in scene.parameters().items():
        assert torch.equal(stored.parameters()[name], tensor), name
    camera = replace(CAMERA, cam_from_world=CAMERA.cam_from_world.float())
    renderer = RECIPE.renderer()
    assert torch.equal(renderer(stored, camera).rgb, renderer(scene, camera).rgb)


def test_normals_spread_beside_mirrors_and_nowhere_else() -> None:
    scene = in_single_precision(glossy(1e-3))
    primary = scene.primary
    along = torch.arange(len(primary), dtype=torch.float32)
    strengths = torch.where(along == 2, 2.0, -6.0)
    # A row of Gaussians, farther and farther apart: the first ones have the mirror among their neighbours.
    means = torch.stack([1.5**along, torch.zeros_like(along), torch.zeros_like(along)], dim=1)
    primary = primary.with_tensors({"logit_strength": strengths, "means": means})
    near = beside_mirrors(primary, 0.02)
    assert bool(near[:16].all()) and not bool(near[20:].any())
    state = TrainState(replace(scene, primary=primary), seed=0)
    spread = SpreadMirrors(Every(0.1), NormalPropagation())
    clock = Clock(4, 40, 6)
    assert spread.due(clock) and spread.apply(state, tiny_capture(), clock)
    found = state.scene.primary
    for name, tensor in primary.tensors().items():
        assert torch.equal(found.tensors()[name][~near], tensor[~near]), name
    assert float(torch.sigmoid(found.logit_opacities[near]).min()) > 0.89
    assert float((found.log_scales - primary.log_scales)[2].max()) > 0
    assert not torch.equal(found.sh[near], primary.sh[near])
    dull = replace(state.scene, primary=primary.with_tensors({"logit_strength": torch.full_like(strengths, -6.0)}))
    assert not spread.apply(TrainState(dull, seed=0), tiny_capture(), clock)


def test_what_is_seen_in_a_pane_does_not_look_like_a_mirror() -> None:
    """Of a mirror in which the photographs show something else, the things behind it are not to blame."""
    scene = true_scene()
    mirror = scene.planes.with_tensors({"logit_reflectances": torch.tensor([30.0])})
    behind = scene.primary.means[:, 2] > 2.2
    generator = torch.Generator().manual_seed(5)
    views = []
    for view in tiny_capture().train:
        with torch.no_grad():
            frame = Planar()(replace(scene, planes=mirror), view.camera)
        noise = torch.rand(3, generator=generator) - 0.5
        photo = frame.rgb + noise * (frame.layers["share"][..., None] > 0.5)
        photo = (255 * photo.clamp(0, 1)).to(torch.uint8)
        views.append(View.in_memory(view.name, view.camera, photo=photo))
    shown, spreads = residual_spreads(replace(scene, planes=mirror), views, Planar())
    unshown, _ = residual_spreads(replace(scene, planes=scene.planes.select([])), views, Planar())
    assert float(shown[behind].sum()) < 0.9 * float(unshown[behind].sum())
    seen = shown > 1.0
    assert bool(seen.any()) and float(spreads[seen].median()) < 0.02


def test_what_has_the_outlines_of_a_ball_becomes_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("glassplat.densify.outlines.REFINE_STEPS", 3)
    around = surrounded()
    offsets = 0.15 * torch.randn(41, 3, generator=torch.Generator().manual_seed(0))
    offsets[0] = torch.tensor([0.0, 2.0, 0.0])
    primary = Gaussians(
        means=TRUE.center + offsets,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(41, 1),
        log_scales=torch.full((41, 3), -1.8),
        logit_opacities=torch.full((41,), 4.0),
        sh=torch.zeros(41, 1, 3),
        channels={"logit_strength": torch.tensor([-5.0] + 40 * [2.0]), "log_intensity": torch.zeros(41)},
    )
    state = TrainState(replace(around, primary=primary), seed=0)
    photo = torch.zeros(36, 48, 3, dtype=torch.uint8)
    views = tuple(View.in_memory(f"{i}.png", camera, photo=photo) for i, camera in enumerate(cameras()))
    dataset = replace(tiny_capture(), train=views)
    begin = replace(PlanarRecipe(curved=CurvedMirrors(learn=True)).stages(0)[3].entry, least_overlap=0.5)
    assert isinstance(begin, BeginCurved)
    begin._reshape(state, dataset)
    made = state.scene.primary
    assert RESHAPED in state.records and len(made) == 1 + 1500
    assert torch.equal(made.means[0], primary.means[0])
    radii = (made.means[1:] - TRUE.center).norm(dim=1)
    assert float(radii.min()) > 0.3 and float(radii.max()) < 1.0
    assert bool((made.channels["logit_strength"][1:] == 2).all())
    spread = SpreadMirrors(Every(0.1), NormalPropagation())
    assert not spread.apply(state, dataset, Clock(4, 40, 6))
    # What is no ellipsoid stays as it was found.
    other = TrainState(replace(around, primary=primary), seed=0)
    replace(begin, least_overlap=0.999)._reshape(other, dataset)
    assert len(other.scene.primary) == 41 and RESHAPED not in other.records
