"""Start of reflections: the initial surroundings, and the Gaussians treated as mirrors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from glassplat.methods.glossy_recipes import DeferredRecipe, Mirrors, TracedRecipe
from glassplat.methods.mirrors import GrowShAfterPropagation
from glassplat.methods.surroundings import BeginReflections
from glassplat.scene import logit
from glassplat.scene.scene import Scene
from glassplat.training.actions import GrowSh, ResetOpacity
from glassplat.training.options import MirrorSearch
from glassplat.training.stage import TrainState
from tests.training.progress_of import followed
from tests.training.tiny_capture import tiny_capture

Found = Callable[..., tuple[Tensor, Tensor]]
"""Stands in for `mirror_lookalikes`."""


def every_3rd(options: MirrorSearch, scene: Scene, views: object, renderer: object) -> tuple[Tensor, Tensor]:
    """Treats every third Gaussian as a mirror."""
    rows = torch.arange(len(scene.primary))
    return torch.ones_like(rows, dtype=torch.bool), rows % 3 == 0


def nothing(options: MirrorSearch, scene: Scene, views: object, renderer: object) -> tuple[Tensor, Tensor]:
    """Finds no mirror."""
    seen = torch.ones(len(scene.primary), dtype=torch.bool)
    return seen, torch.zeros_like(seen)


def begun(
    found: Found,
    search: MirrorSearch | None = None,
    *,
    near: bool = True,
    reset_sh_degree: bool = False,
) -> tuple[TrainState, list[str]]:
    """A state in which reflections have started, and the messages of the start."""
    state = TrainState(TracedRecipe(sh_degree=1).initialise(tiny_capture()), seed=0)
    state.scene = replace(state.scene, primary=replace(state.scene.primary, active_sh_degree=1))
    ones = {name: torch.ones_like(tensor) for name, tensor in state.scene.primary.tensors().items()}
    state.optimizer.moments = {f"primary.{name}": (tensor, tensor.clone()) for name, tensor in ones.items()}
    recipe = TracedRecipe(first_texels=2, search=search or MirrorSearch())
    setup = BeginReflections(recipe, recipe.surroundings if near else None, reset_sh_degree=reset_sh_degree)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("glassplat.methods.surroundings.mirror_lookalikes", found)
        messages, _ = followed(setup(state, tiny_capture()))
    return state, [message.what for message in messages]


def test_mirror_like_gaussians_become_mirrors_and_the_rest_surroundings() -> None:
    state, told = begun(every_3rd)
    count = len(state.scene.primary)
    chosen = torch.arange(count) % 3 == 0
    strengths = torch.sigmoid(state.scene.primary.channels["logit_strength"])
    assert strengths[chosen].tolist() == pytest.approx([0.73] * int(chosen.sum()))
    assert strengths[~chosen].max() < 0.01
    assert len(state.scene.surroundings) == int((~chosen).sum())
    assert not state.scene.environment.is_empty and told == ["looking for mirrors"]
    for name, (first, second) in state.optimizer.moments.items():
        for moment in (first, second):
            assert not bool(moment[chosen].any()) and bool((moment[~chosen] == 1).all()), name


def test_the_papers_start_from_hardly_any_reflection() -> None:
    state, _ = begun(every_3rd, MirrorSearch(begin_found=False))
    assert float(state.scene.primary.channels["logit_strength"].max()) < logit(0.01)
    assert all(bool((first == 1).all()) for first, _ in state.optimizer.moments.values())
    # Mirror-like Gaussians are nevertheless not copied.
    assert len(state.scene.surroundings) < len(state.scene.primary)


def test_mirrors_are_not_searched_for_if_nothing_needs_them() -> None:
    state, told = begun(every_3rd, MirrorSearch(begin_found=False), near=False)
    assert told == [] and not state.scene.environment.is_empty and not len(state.scene.surroundings)


@pytest.mark.parametrize("recipe", [DeferredRecipe(), TracedRecipe(), DeferredRecipe.paper(), TracedRecipe.paper()])
def test_before_mirrors_are_searched_for_a_scene_is_learned_as_by_splat(recipe: DeferredRecipe | TracedRecipe) -> None:
    for search in (MirrorSearch(), MirrorSearch(begin_found=False)):
        bootstrap = replace(recipe, search=search, least_iterations=1).stages(0, 7000)[0]
        kinds = {type(action) for action in bootstrap.actions}
        assert ResetOpacity in kinds
        assert (GrowSh in kinds) == (search.begin_found or getattr(recipe, "harmonics_from_start", False))
        raised_rates = bootstrap.rates["primary.means"].short_run_power > 0
        assert raised_rates == (search.begin_found and recipe.raise_rates_matte)


@pytest.mark.parametrize("kind", [DeferredRecipe, TracedRecipe])
def test_mirrors_are_searched_for_but_not_in_the_papers(kind: type[DeferredRecipe | TracedRecipe]) -> None:
    assert kind().search.begin_found and not kind.paper().search.begin_found


@pytest.mark.parametrize(
    ("found", "begin_found", "degree"), [(every_3rd, True, 0), (nothing, True, 1), (every_3rd, False, 1)]
)
def test_harmonics_are_reset_if_mirrors_are_found(found: Found, begin_found: bool, degree: int) -> None:
    state, _ = begun(found, MirrorSearch(begin_found=begin_found), reset_sh_degree=True)
    assert state.scene.primary.active_sh_degree == degree
    assert begun(found, MirrorSearch(begin_found=begin_found))[0].scene.primary.active_sh_degree == 1


@pytest.mark.parametrize("recipe", [DeferredRecipe(), TracedRecipe()])
def test_colors_wait_until_normals_have_spread(recipe: DeferredRecipe | TracedRecipe) -> None:
    stage = recipe.stages(0, 7000)[1]
    assert isinstance(stage.setup, BeginReflections) and stage.setup.reset_sh_degree
    assert any(isinstance(action, GrowShAfterPropagation) for action in stage.actions)


@pytest.mark.parametrize("mirrors", ["both", "surroundings", "environment"])
def test_colors_that_turn_from_the_start_are_not_reset(mirrors: Mirrors) -> None:
    setup = TracedRecipe(mirrors=mirrors, harmonics_from_start=True).stages(0, 7000)[1].setup
    assert isinstance(setup, BeginReflections) and not setup.reset_sh_degree
