"""Exposures change the colours of their own photographs, and no others."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.evaluate.evaluate import time_render
from glassplat.render.deferred import Deferred
from glassplat.render.frame import Frame
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.corrections import Exposures
from glassplat.training.losses import PhotometricLoss
from tests.render.test_deferred import glossy
from tests.training.tiny_capture import tiny_capture, true_scene


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_a_neutral_exposure_changes_nothing() -> None:
    image = drawn(4, 5, 3)
    torch.testing.assert_close(Exposures.neutral(("a",)).apply(image.float(), "a"), image.float())
    assert Exposures.neutral().apply(image, "a") is image


def test_a_transform_is_applied_to_its_photograph_only() -> None:
    affine = torch.zeros(2, 3, 4, dtype=torch.float64)
    affine[1, 0, 1], affine[1, 2, 3] = 0.5, -0.1
    exposures, image = Exposures(affine, ("a", "b")), drawn(4, 5, 3)
    torch.testing.assert_close(exposures.apply(image, "a"), image)
    expected = image.clone()
    expected[..., 0] += 0.5 * image[..., 1]
    expected[..., 2] -= 0.1
    torch.testing.assert_close(exposures.apply(image, "b"), expected)


def test_as_many_transforms_as_names_are_expected() -> None:
    with pytest.raises(ValueError, match=r"expected \[1, 3, 4\]"):
        Exposures(torch.zeros(2, 3, 4), ("a",))


def test_the_loss_compares_in_the_colours_of_the_photograph() -> None:
    view, scene = tiny_capture().train[0], true_scene()
    photo = view.photo.float() / 255
    affine = torch.zeros(1, 3, 4)
    affine[0, :, :3] = -0.5 * torch.eye(3)
    exposed = replace(scene, exposures=Exposures(affine, (view.name,)))
    frame = Frame(2 * photo, {"alpha": torch.ones_like(photo[..., 0])})
    assert float(PhotometricLoss(0.2)(frame, view, exposed)) < 1e-5
    assert float(PhotometricLoss(0.2)(frame, view, scene)) > 0.05


@pytest.mark.parametrize("renderer", [Splat(), Planar(), Deferred()])
def test_the_background_is_not_exposed(renderer: Splat | Planar | Deferred) -> None:
    scene, view, color = glossy(0.8).to(torch.float32), tiny_capture().train[2], (1.0, 0.6, 0.2)
    exposures, black = Exposures(0.2 * drawn(1, 3, 4).float(), ("a",)), renderer(scene, view.camera)
    frame, _ = time_render(replace(renderer, background=color), scene, view)
    behind = frame.rgb - black.rgb
    uncovered = behind / torch.tensor(color)
    assert float(uncovered.max()) > 0.5
    own = exposures.apply(black.rgb, "a") - uncovered * exposures.values[0, :, 3]
    torch.testing.assert_close(frame.exposed(exposures, "a"), own + behind)


def test_a_mirror_in_front_of_nothing_is_exposed() -> None:
    exposures, image, empty = Exposures(drawn(1, 3, 4), ("a",)), drawn(4, 5, 3, seed=1), drawn(4, 5) * 0
    frame = Frame(image, {"alpha": empty, "strength": empty, "share": empty + 1}, background=(1.0, 0.6, 0.2))
    torch.testing.assert_close(frame.exposed(exposures, "a"), exposures.apply(image, "a"))
    with pytest.raises(ValueError, match="has the layers depth; expected alpha among them"):
        Frame(image, {"depth": empty}).exposed(exposures, "a")
    assert Frame(image).exposed(exposures, "of no photograph") is image


def test_gradients_reach_image_coverage_and_transform() -> None:
    def exposed(image: torch.Tensor, alpha: torch.Tensor, affine: torch.Tensor) -> torch.Tensor:
        return Frame(image, {"alpha": alpha}, background=(1.0, 0.6, 0.2)).exposed(Exposures(affine, ("a", "b")), "b")

    inputs = drawn(3, 2, 3), drawn(3, 2, seed=1), 0.1 * drawn(2, 3, 4, seed=2)
    assert torch.autograd.gradcheck(exposed, tuple(tensor.requires_grad_() for tensor in inputs))


def test_a_view_without_a_transform_gets_the_mean_of_its_neighbours() -> None:
    exposures = Exposures(drawn(4, 3, 4), ("x/8.png", "x/10.png", "y/9.png", "x/12.png"))
    found = exposures.interpolate("x/9.png")
    torch.testing.assert_close(found.values_of("x/9.png"), exposures.values[:2].mean(dim=0))
    torch.testing.assert_close(exposures.interpolate("x/20.png").values_of("x/20.png"), exposures.values[3])
    assert exposures.interpolate("x/10.png") is exposures
    assert exposures.interpolate("z/9.png") is exposures
    assert len(Exposures.neutral().interpolate("a")) == 0


def test_an_exposure_can_be_inverted() -> None:
    exposures = Exposures(0.2 * drawn(2, 3, 4, seed=1), ("a", "b"))
    image = drawn(4, 5, 3)
    torch.testing.assert_close(exposures.apply_inverse(exposures.apply(image, "b"), "b"), image)
    assert exposures.apply_inverse(image, "c") is image
