"""Edits of the set of Gaussians and of the moments that follow them."""

import math

import pytest
import torch

from glassplat.scene.camera import rotation_from_quat
from glassplat.scene.gaussians import Gaussians
from glassplat.training.densify import Edit, append, apply_edit, clone, keep, split, zero_moments


def make_gaussians(count: int, seed: int = 0) -> Gaussians:
    rng = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=rng),
        quats=torch.randn(count, 4, generator=rng),
        log_scales=torch.randn(count, 3, generator=rng) - 2,
        logit_opacities=torch.randn(count, generator=rng),
        sh=torch.randn(count, 4, 3, generator=rng),
        channels={"log_intensity": torch.randn(count, generator=rng)},
    )


def make_moments(gaussians: Gaussians, part: str = "primary") -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    tensors = {f"{part}.{name}": tensor for name, tensor in gaussians.tensors().items()}
    return {name: (tensor + 10, tensor.square() + 20) for name, tensor in tensors.items()}


def test_keep_removes_the_same_rows_of_every_tensor_and_moment() -> None:
    gaussians = make_gaussians(5)
    mask = torch.tensor([True, False, True, True, False])
    kept, moments = apply_edit(gaussians, make_moments(gaussians), keep(mask))
    for name, tensor in gaussians.tensors().items():
        assert torch.equal(kept.tensors()[name], tensor[mask])
        assert torch.equal(moments[f"primary.{name}"][0], tensor[mask] + 10)


def test_clone_copies_values_but_starts_moments_at_zero() -> None:
    gaussians = make_gaussians(4)
    cloned, moments = apply_edit(gaussians, make_moments(gaussians), clone(4, torch.tensor([2, 0])))
    assert torch.equal(cloned.sh, gaussians.sh[[0, 1, 2, 3, 2, 0]])
    first, second = moments["primary.sh"]
    assert torch.equal(first[:4], gaussians.sh + 10)
    assert not first[4:].any()
    assert not second[4:].any()


def test_moments_of_other_parts_pass_through_untouched() -> None:
    gaussians = make_gaussians(4)
    glass = make_moments(gaussians, "glass")
    _, moments = apply_edit(gaussians, make_moments(gaussians) | glass, keep(torch.arange(4) < 2))
    assert all(moments[name] is pair or moments[name][0] is pair[0] for name, pair in glass.items())
    assert moments["primary.means"][0].shape == (2, 3)


def test_split_children_are_distributed_like_their_parent() -> None:
    count = 20_000
    angle = 0.7
    parent = Gaussians(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        quats=torch.tensor([[math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]]),
        log_scales=torch.tensor([[2.0, 0.5, 0.1]]).log(),
        logit_opacities=torch.zeros(1),
        sh=torch.zeros(1, 1, 3),
    )
    rng = torch.Generator().manual_seed(1)
    alike = parent.select(torch.zeros(count // 2, dtype=torch.int64))
    children, _ = apply_edit(alike, {}, split(alike, torch.arange(count // 2), generator=rng))
    assert len(children) == count
    rotation = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0.0, 0.0, 1.0]]
    )
    covariance = rotation @ torch.diag(torch.tensor([4.0, 0.25, 0.01])) @ rotation.T
    assert children.means.mean(dim=0) == pytest.approx(parent.means[0], abs=0.05)
    assert torch.allclose(torch.cov(children.means.T), covariance, atol=0.1)
    assert torch.allclose(children.log_scales, parent.log_scales - math.log(1.6))


def test_split_replaces_parents_and_leaves_the_rest() -> None:
    gaussians = make_gaussians(5)
    edit = split(gaussians, torch.tensor([1, 3]), generator=torch.Generator().manual_seed(0))
    after, moments = apply_edit(gaussians, make_moments(gaussians), edit)
    assert edit.source.tolist() == [0, 2, 4, 1, 3, 1, 3]
    assert torch.equal(after.means[:3], gaussians.means[[0, 2, 4]])
    assert not torch.equal(after.means[3:5], gaussians.means[[1, 3]])
    assert not moments["primary.means"][0][3:].any()
    assert torch.equal(moments["primary.means"][0][:3], gaussians.means[[0, 2, 4]] + 10)


def test_composed_edit_equals_one_after_the_other() -> None:
    gaussians = make_gaussians(6)
    moments = make_moments(gaussians)
    first = split(gaussians, torch.tensor([4]), generator=torch.Generator().manual_seed(3))
    second = keep(torch.tensor([True, False, True, True, False, True, True])).then(clone(5, torch.tensor([4])))
    stepwise = apply_edit(*apply_edit(gaussians, moments, first), second)
    at_once = apply_edit(gaussians, moments, first.then(second))
    for name, tensor in stepwise[0].tensors().items():
        assert torch.equal(tensor, at_once[0].tensors()[name])
        assert torch.equal(stepwise[1][f"primary.{name}"][1], at_once[1][f"primary.{name}"][1])


def test_edits_do_not_change_the_input_or_autograd_state() -> None:
    gaussians = make_gaussians(3)
    trainable = gaussians.with_tensors({"means": gaussians.means.clone().requires_grad_()})
    before = trainable.means.detach().clone()
    rng = torch.Generator().manual_seed(0)
    after, _ = apply_edit(trainable, {}, split(trainable, torch.tensor([0]), generator=rng))
    assert not after.means.requires_grad
    assert torch.equal(trainable.means, before)


def test_append_extends_moments_with_zeros() -> None:
    gaussians, new = make_gaussians(3), make_gaussians(2, seed=9)
    joined, moments = append(gaussians, make_moments(gaussians), new)
    assert torch.equal(joined.means, torch.cat([gaussians.means, new.means]))
    assert torch.equal(moments["primary.log_intensity"][0][:3], gaussians.channels["log_intensity"] + 10)
    assert not moments["primary.log_intensity"][1][3:].any()


def test_forget_zeroes_only_what_was_replaced() -> None:
    gaussians = make_gaussians(3)
    original = make_moments(gaussians)
    moments = zero_moments(original, ("primary.sh",), torch.tensor([False, True, False]))
    assert not moments["primary.sh"][0][1].any()
    assert torch.equal(moments["primary.sh"][0][[0, 2]], original["primary.sh"][0][[0, 2]])
    assert torch.equal(moments["primary.means"][1], original["primary.means"][1])
    assert original["primary.sh"][0][1].any()
    assert not zero_moments(original, ("primary.sh",))["primary.sh"][1].any()


@pytest.mark.parametrize("count", [0, 1])
def test_empty_sets_are_valid_in_every_edit(count: int) -> None:
    gaussians = make_gaussians(count)
    nothing = torch.zeros(0, dtype=torch.int64)
    edit = split(gaussians, nothing, generator=torch.Generator().manual_seed(0)).then(clone(count, nothing))
    after, moments = apply_edit(gaussians, make_moments(gaussians), edit.then(keep(torch.zeros(count) > 0)))
    assert len(after) == 0
    assert moments["primary.means"][0].shape == (0, 3)


def test_an_edit_with_rows_missing_is_refused() -> None:
    with pytest.raises(ValueError, match="means has 2 rows where source has 3"):
        Edit(torch.arange(3), torch.zeros(3, dtype=torch.bool), {"means": torch.zeros(2, 3)})


def test_children_of_discs_lie_in_their_plane() -> None:
    discs = Gaussians(
        means=torch.zeros(50, 3),
        quats=torch.tensor([0.9, 0.1, -0.3, 0.2]).repeat(50, 1),
        log_scales=torch.zeros(50, 2),
        logit_opacities=torch.zeros(50),
        sh=torch.zeros(50, 1, 3),
    )
    edit = split(discs, torch.arange(50), generator=torch.Generator().manual_seed(0))
    means = edit.edited_tensor(discs, "means")
    normal = rotation_from_quat(discs.quats)[0, :, 2]
    assert edit.edited_tensor(discs, "log_scales").shape == (100, 2)
    assert float((means @ normal).abs().max()) < 1e-5 < 0.3 < float(means.norm(dim=1).mean())
