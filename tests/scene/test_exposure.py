"""Exposures change the colours of their own photographs, and no others."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.render.frame import Frame
from glassplat.scene.corrections import Exposures
from glassplat.training.losses import PhotometricLoss
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


def test_gradients_reach_image_and_transform() -> None:
    image, affine = drawn(3, 2, 3).requires_grad_(), (0.1 * drawn(2, 3, 4, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda i, a: Exposures(a, ("a", "b")).apply(i, "b"), (image, affine))


def test_as_many_transforms_as_names_are_expected() -> None:
    with pytest.raises(ValueError, match=r"expected \[1, 3, 4\]"):
        Exposures(torch.zeros(2, 3, 4), ("a",))


def test_the_loss_compares_in_the_colours_of_the_photograph() -> None:
    view, scene = tiny_capture().train[0], true_scene()
    photo = view.photo.float() / 255
    affine = torch.zeros(1, 3, 4)
    affine[0, :, :3] = -0.5 * torch.eye(3)
    exposed = replace(scene, exposures=Exposures(affine, (view.name,)))
    assert float(PhotometricLoss(0.2)(Frame(2 * photo), view, exposed)) < 1e-5
    assert float(PhotometricLoss(0.2)(Frame(2 * photo), view, scene)) > 0.05


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
