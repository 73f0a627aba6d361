"""Patches that the scene cannot explain are left out of the loss, once there is a scene."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.losses.photometric import PhotometricLoss, outlying
from glassplat.render.frame import Frame
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.robust_weighting import Robustness
from glassplat.train.splat_recipe import SplatRecipe
from glassplat.train.stage import Stage, stage_starts
from tests.train.tiny_capture import tiny_capture, true_scene

SIZE = (60, 100)


def noisy(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """An image and a photograph that differ by noise."""
    generator = torch.Generator().manual_seed(seed)
    photo = torch.rand(*SIZE, 3, generator=generator)
    return photo + 0.03 * torch.randn(*SIZE, 3, generator=generator), photo


def test_a_passer_by_is_left_out_and_little_else() -> None:
    image, photo = noisy()
    body = torch.zeros(SIZE, dtype=torch.bool)
    body[10:50, 40:52] = True
    photo[body] = photo[body] * 0.2
    found = outlying(image, photo, 4.0)
    assert float(found[body].float().mean()) > 0.95
    apart = torch.nn.functional.max_pool2d(body.float()[None], 9, 1, 4)[0] == 0
    assert not bool(found[apart].any())


def test_without_one_nothing_is_left_out() -> None:
    assert not bool(outlying(*noisy(), 4.0).any())
    same = noisy()[1]
    assert not bool(outlying(same, same, 4.0).any())


def test_a_single_wrong_pixel_is_no_passer_by() -> None:
    image, photo = noisy()
    image[30, 30] = photo[30, 30] + 0.5
    assert not bool(outlying(image, photo, 4.0).any())


def test_what_is_left_out_has_no_gradient() -> None:
    view = tiny_capture().train[0]
    right = view.photo.float() / 255
    wrong = (right + 0.01 * torch.rand(right.shape, generator=torch.Generator().manual_seed(1))).clone()
    wrong[8:18, 10:20] = 1 - right[8:18, 10:20]
    image = wrong.requires_grad_()
    left_out = outlying(image.detach(), right, 4.0)
    assert bool(left_out[10:16, 12:18].all()) and not bool(left_out.all())
    loss = PhotometricLoss(0.2, outliers=4.0)(Frame(image), view, true_scene())
    (gradient,) = torch.autograd.grad(loss, image)
    assert not bool(gradient[left_out].any()) and bool(gradient[~left_out].any())
    assert float(loss.detach()) < 0.3 * float(PhotometricLoss(0.2)(Frame(wrong.detach()), view, true_scene()))


def thresholds(stages: tuple[Stage, ...], iterations: int) -> list[float]:
    """That of each step."""
    starts = stage_starts(stages, iterations)
    return [
        next(t.function.outliers for t in stage.losses if isinstance(t.function, PhotometricLoss))
        for stage, start, end in zip(stages, starts, starts[1:], strict=False)
        for _ in range(start, end)
    ]


@pytest.mark.parametrize("recipe", [SplatRecipe(), PlanarRecipe(), SplatRecipe(primitive="disc")])
@pytest.mark.parametrize("start", [0.0, 0.1, 0.25])
def test_it_begins_at_a_share_of_the_run_and_changes_nothing_else(
    recipe: SplatRecipe | PlanarRecipe, start: float
) -> None:
    plain = recipe.stages(0)
    robust = replace(recipe, robust=Robustness(4.0, start)).stages(0)
    found = thresholds(robust, 1000)
    assert found == [0.0] * round(1000 * start) + [4.0] * (1000 - round(1000 * start))
    assert [stage.entry for stage in robust if stage.entry] == [stage.entry for stage in plain if stage.entry]
    assert {stage.name for stage in robust} == {stage.name for stage in plain}
    assert set(thresholds(plain, 1000)) == {0.0}
