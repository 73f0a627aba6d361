"""Reflection and geometry losses."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from glassplat.captures.view import View
from glassplat.kernels.maths.images import linear_from_srgb, srgb_from_linear
from glassplat.render.frame import Frame
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene
from glassplat.training.losses import (
    LossFunction,
    ReflectancePrior,
    cell_gradient_conflict,
    depth_deviation,
    gradient_conflict,
    intensity_prior,
    mask_difference,
    tint_prior,
)


def frame_with(**layers: torch.Tensor) -> Any:
    return Frame(rgb=torch.zeros(8, 9, 3), layers=layers)


def conflict(
    transmission: torch.Tensor,
    reflection: torch.Tensor,
    pane: torch.Tensor,
    strength: torch.Tensor,
    term: LossFunction = gradient_conflict,
) -> float:
    layers = {"without_panes": transmission, "reflection": reflection, "pane": pane, "strength": strength}
    return float(term(frame_with(**layers), SimpleNamespace(), SimpleNamespace()))  # type: ignore[arg-type]


STEP = (torch.arange(9) >= 4).float()[None, :, None].expand(8, 9, 3)
FLAT = torch.full((8, 9, 3), 0.5)
ALL = torch.zeros(8, 9, dtype=torch.int32)
EVEN = torch.full((8, 9), 0.1)


BOTH = pytest.mark.parametrize("term", [gradient_conflict, cell_gradient_conflict])


@pytest.mark.parametrize(
    ("term", "transmission"), [(gradient_conflict, STEP), (cell_gradient_conflict, FLAT + 0.05 * STEP)]
)
def test_gradient_conflict_counts_shared_edges_on_panes_only(term: LossFunction, transmission: Tensor) -> None:
    assert conflict(transmission, STEP, ALL, EVEN, term) > 0
    assert conflict(transmission, FLAT, ALL, EVEN, term) == 0
    assert conflict(transmission, STEP, ALL - 1, EVEN, term) == 0


@BOTH
def test_the_border_of_a_pane_is_no_edge_of_the_reflection(term: LossFunction) -> None:
    """At the rectangle's rim, without glass, and at the border to the next pane, with a frame behind each."""
    right = STEP[..., 0] > 0
    rim = torch.where(right, ALL, -1)
    assert conflict(STEP, FLAT * STEP, rim, EVEN * right, term) == 0
    assert conflict(STEP, FLAT * STEP, ALL, EVEN * right, term) == 0
    assert conflict(STEP, FLAT + 0.3 * STEP, right.to(torch.int32), EVEN, term) == 0


def left_in(own: float, held: float, gain: float = 1.0) -> float:
    """Strength of the term's gradient on a transmission with its own texture that holds a share of a reflection."""
    texture, room = (_edges_and_ramps(seed, height=96, width=128) for seed in (2, 3))
    strength = torch.full((96, 128), 0.1)
    # In linear light, in which the reflection of a pane is added.
    transmission = srgb_from_linear(0.2 + 0.5 * own * texture + 0.1 * held * linear_from_srgb(room)).requires_grad_()
    layers = {"without_panes": transmission, "reflection": gain * room, "strength": strength}
    frame = frame_with(**layers, pane=torch.zeros(96, 128, dtype=torch.int32))
    loss = cell_gradient_conflict(frame, SimpleNamespace(), SimpleNamespace())  # type: ignore[arg-type]
    (gradient,) = torch.autograd.grad(loss, transmission)
    return float(gradient.norm())


def test_remaining_reflection_edges_are_penalised_and_shared_edges_are_not() -> None:
    """A full-strength edge of the transmission is its own, even if the reflection contains it as well."""
    assert left_in(0.0, 5.0) < 0.2 * left_in(0.0, 0.5)


def test_an_overexposed_reflection_has_a_bounded_gradient() -> None:
    """Otherwise it would grow without limit: light that it takes from the transmission has to be replaced."""
    assert left_in(1.0, 1.0, gain=20.0) <= left_in(1.0, 1.0, gain=1.0)


def test_edges_next_to_a_rim_still_count() -> None:
    narrow = torch.where(torch.arange(9) >= 2, ALL, -1)
    assert conflict(STEP, STEP, narrow, EVEN) == conflict(STEP, STEP, ALL, EVEN)


def test_gradient_conflict_depends_little_on_the_size_of_photographs() -> None:
    """The same view at four sizes; without the factor, the smallest has 14 times the loss of the largest."""
    transmission, reflection = (_edges_and_ramps(seed, height=480, width=640) for seed in (0, 1))
    losses = []
    for shrink in (1, 2, 4, 8):
        smaller = [_shrunk(image, shrink) for image in (transmission, reflection)]
        everywhere = torch.zeros(smaller[0].shape[:2], dtype=torch.int32)
        losses.append(conflict(*smaller, everywhere, torch.full(everywhere.shape, 0.1)))
    assert max(losses) < 2.5 * min(losses)


def _edges_and_ramps(seed: int, *, height: int, width: int) -> Tensor:
    """An image of overlapping soft-edged shapes with edges at all scales, as in natural images."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / height, indexing="ij")
    image = torch.zeros(height, width, 3)
    for _ in range(60):
        center_x, center_y, log_size, angle, softness = torch.rand(5, generator=generator).tolist()
        size = 0.5 * math.exp(-3 * log_size)
        across = (x - 1.4 * center_x) * math.cos(6 * angle) + (y - center_y) * math.sin(6 * angle)
        along = (y - center_y) * math.cos(6 * angle) - (x - 1.4 * center_x) * math.sin(6 * angle)
        inside = torch.sigmoid((size - torch.maximum(across.abs(), along.abs())) / (1e-3 + 0.1 * size * softness))
        color = torch.rand(3, generator=generator)
        image = image + inside[..., None] * (color - image)
    return image


def _shrunk(image: Tensor, factor: int) -> Tensor:
    return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), factor).permute(1, 2, 0)


def test_gradient_conflict_leaves_the_reflection_alone() -> None:
    transmission = torch.rand(8, 9, 3, requires_grad=True)
    reflection = torch.rand(8, 9, 3, requires_grad=True)
    frame = frame_with(without_panes=transmission, reflection=reflection, pane=ALL, strength=EVEN)
    loss = gradient_conflict(frame, SimpleNamespace(), SimpleNamespace())
    to_transmission, to_reflection = torch.autograd.grad(loss, [transmission, reflection], allow_unused=True)
    assert float(to_transmission.abs().sum()) > 0 and to_reflection is None


def test_mask_loss_applies_to_annotated_views_only() -> None:
    frame = frame_with(mask=torch.full((8, 9), 0.25))
    labels = torch.zeros(8, 9, dtype=torch.uint8)
    labels[:4] = 2
    assert mask_difference(frame, SimpleNamespace(pane_labels=None), SimpleNamespace()) is None
    annotated = mask_difference(frame, SimpleNamespace(pane_labels=labels, ignored=None), SimpleNamespace())
    torch.testing.assert_close(annotated, torch.tensor(0.5 * 0.75 + 0.5 * 0.25))


def test_people_in_front_of_a_pane_leave_no_hole_in_it() -> None:
    mask = torch.full((8, 9), 0.25, requires_grad=True)
    labels = torch.ones(8, 9, dtype=torch.uint8)
    ignored = torch.zeros(8, 9, dtype=torch.bool)
    ignored[2:5, 3:7] = True
    view = SimpleNamespace(pane_labels=labels, ignored=ignored)
    (gradient,) = torch.autograd.grad(mask_difference(frame_with(mask=mask), view, SimpleNamespace()), mask)
    assert not bool(gradient[ignored].any()) and bool((gradient[~ignored] < 0).all())


def test_reflections_depart_from_what_they_mirror_as_much_darker_as_brighter() -> None:
    def departure(intensity: float) -> float:
        primary = SimpleNamespace(channels={"log_intensity": torch.tensor([0.0, intensity]).log1p()})
        return float(intensity_prior(frame_with(), SimpleNamespace(), SimpleNamespace(primary=primary)))

    assert departure(0.0) == 0
    assert abs(departure(1.0) - departure(-0.5)) < 1e-6
    assert departure(2.0) > departure(1.0) > 0


def test_depth_deviation_loss_does_not_depend_on_the_unit_of_length() -> None:
    deviation, hit = torch.rand(8, 9), torch.ones(8, 9)
    metres = depth_deviation(frame_with(deviation=deviation, hit=hit), SimpleNamespace(), SimpleNamespace(extent=2.0))
    millimetres = depth_deviation(
        frame_with(deviation=1000 * deviation, hit=hit), SimpleNamespace(), SimpleNamespace(extent=2000.0)
    )
    torch.testing.assert_close(metres, millimetres)


def test_the_tint_term_is_zero_for_clear_glass_and_its_mean_square_otherwise() -> None:
    def term(planes: Planes) -> Tensor | None:
        return tint_prior(frame_with(), cast(View, None), Scene(Gaussians.empty(), 1.0, planes=planes))

    clear = Planes.rectangle((0, 0, 0), (0, 0, 1), (1, 1))
    assert term(clear) is None
    still_clear = term(clear.that_may_tint())
    assert still_clear is not None and float(still_clear) == 0
    tinted = term(replace(clear, log_transmittances=torch.tensor([[-0.3, 0.0, 0.3]])))
    assert tinted is not None and float(tinted) == pytest.approx(0.06)


def test_glass_is_held_to_what_is_expected_of_it_by_its_share_of_the_image_and_mirrors_are_not() -> None:
    logits = torch.tensor([-1.0, -2.0, 6.0], requires_grad=True)
    places = torch.eye(3)
    planes = Planes(places, places, logits, places.roll(1, 0), torch.ones(3, 2), labels=(1, 2, 3), mirrors=(3,))
    pane = torch.full((4, 5), -1, dtype=torch.int32)
    pane[0], pane[1:3], pane[3] = 0, 1, 2
    departure = ReflectancePrior(0.1)
    term = departure(frame_with(pane=pane), cast(View, None), Scene(Gaussians.empty(), 1.0, planes=planes))
    assert term is not None
    expected = math.log(0.1 / 0.9)
    assert term.item() == pytest.approx(0.25 * (-1 - expected) ** 2 + 0.5 * (-2 - expected) ** 2)
    (gradient,) = torch.autograd.grad(term, logits)
    assert gradient.tolist() == pytest.approx([0.5 * (-1 - expected), -2 - expected, 0.0])
    nobody = Scene(Gaussians.empty(), 1.0)
    assert departure(frame_with(pane=torch.full_like(pane, -1)), cast(View, None), nobody) is None
