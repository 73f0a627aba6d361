"""Normal propagation and colour sabotage."""

import math
from dataclasses import replace

import torch

from glassplat.methods.mirrors import propagate_normals, sabotage_colors
from glassplat.scene import SH_ZERO
from glassplat.scene.gaussians import Gaussians
from glassplat.training.options import NormalPropagation

STRENGTHS = torch.tensor([1e-5, 0.01, 0.03, 0.2, 0.9])


def gaussians() -> Gaussians:
    """Five Gaussians of rising strength, with the second axis the shortest."""
    count = len(STRENGTHS)
    return Gaussians(
        means=torch.zeros(count, 3),
        quats=torch.ones(count, 4),
        log_scales=torch.tensor([0.0, -1.0, 0.5]).repeat(count, 1),
        logit_opacities=torch.logit(torch.tensor([0.05, 0.5, 0.99, 0.05, 0.95])),
        sh=torch.zeros(count, 4, 3),
        channels={"logit_strength": torch.logit(STRENGTHS)},
    )


def moments() -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    return {f"primary.{name}": (torch.ones_like(t), torch.ones_like(t)) for name, t in gaussians().tensors().items()}


def test_opacities_and_strengths_are_raised_to_their_floors() -> None:
    raised, _ = propagate_normals(NormalPropagation(), gaussians(), moments())
    torch.testing.assert_close(raised.logit_opacities.sigmoid(), torch.tensor([0.9, 0.9, 0.99, 0.9, 0.95]))
    torch.testing.assert_close(
        raised.channels["logit_strength"].sigmoid(), torch.tensor([1e-3, 0.01, 0.03, 0.2, 0.9]), rtol=1e-5, atol=1e-8
    )


def test_reflective_gaussians_grow_along_their_surface_only() -> None:
    grown, _ = propagate_normals(NormalPropagation(reflective=0.1, growth=1.5), gaussians(), moments())
    change = grown.log_scales - gaussians().log_scales
    expected = torch.zeros(5, 3)
    expected[3:, [0, 2]] = math.log(1.5)
    torch.testing.assert_close(change, expected)


def test_only_replaced_gaussians_reset_their_moments() -> None:
    _, kept = propagate_normals(NormalPropagation(), gaussians(), moments())
    emptied = {name for name, (first, second) in kept.items() if not first.any() and not second.any()}
    assert emptied == {"primary.logit_opacities", "primary.logit_strength", "primary.log_scales"}
    assert all(bool(first.all()) for name, (first, _) in kept.items() if name not in emptied)


def test_sabotage_disturbs_the_constant_colour_of_what_does_not_reflect() -> None:
    propagation = NormalPropagation(sabotage=0.1, sabotaged=0.1)
    many = replace(gaussians(), channels={"logit_strength": torch.logit(STRENGTHS)})
    disturbed, kept = sabotage_colors(propagation, many, moments(), torch.Generator().manual_seed(0))
    change = disturbed.sh * SH_ZERO
    assert change[:3, 0].abs().min() > 0 and change[:, 0].abs().max() <= 0.1
    assert change[:3, 0].min() < 0 < change[:3, 0].max()
    assert not change[3:].any() and not change[:, 1:].any()
    first, _ = kept["primary.sh"]
    assert not first[:3].any() and first[3:].all()


def test_without_sabotage_colours_stay() -> None:
    changed, kept = sabotage_colors(NormalPropagation(sabotage=0.0), gaussians(), moments(), torch.Generator())
    assert all(torch.equal(t, gaussians().tensors()[name]) for name, t in changed.tensors().items())
    assert all(bool(first.all()) for first, _ in kept.values())


def test_reflective_discs_grow_along_both_axes() -> None:
    solid = gaussians()
    discs = Gaussians(**{**vars(solid), "log_scales": solid.log_scales[:, :2].contiguous()})
    change = propagate_normals(NormalPropagation(), discs, {})[0].log_scales - discs.log_scales
    grows = torch.sigmoid(discs.channels["logit_strength"]) >= 0.02
    torch.testing.assert_close(change[grows], torch.full_like(change[grows], math.log(1.5)))
    assert bool(grows.any()) and not change[~grows].any()
