"""Changing which Gaussians exist, with the optimiser's memory of each following its Gaussian.

Every change is an `Edit`: for each row of the new set the old row it comes from, whether it is a new Gaussian, and
the tensors in which it differs from that old row. Strategies build edits and `apply_edit` carries them out.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from glassplat.scene.gaussians import Gaussians
from glassplat.scene.pose import rotation_from_quat

Moments = Mapping[str, tuple[Tensor, Tensor]]
"""Adam's first and second moment by dotted parameter name (`primary.means`), shaped like the parameter."""


@dataclass(frozen=True)
class Edit:
    """How a new set of M Gaussians is made from an old one.

    Attributes:
        source: [M] int64 row of the old set that each new row copies.
        fresh: [M] bool; true where the row is a new Gaussian, whose moments start at zero.
        replaced: tensors whose values differ from the copies, by name, one row per new Gaussian.
    """

    source: Tensor
    fresh: Tensor
    replaced: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, tensor in {"fresh": self.fresh, **self.replaced}.items():
            if tensor.shape[0] != len(self):
                raise ValueError(
                    f"{name} has {tensor.shape[0]} rows where source has {len(self)}; expected one per new Gaussian"
                )

    def __len__(self) -> int:
        return self.source.shape[0]

    def result(self, gaussians: Gaussians, name: str) -> Tensor:
        """The tensor `name` of the new set, without making the rest of it."""
        return self.replaced[name] if name in self.replaced else gaussians.tensors()[name][self.source]

    def then(self, following: Edit) -> Edit:
        """This edit and, on its result, `following`, as one edit of the original set."""
        replaced = {name: tensor[following.source] for name, tensor in self.replaced.items()}
        fresh = self.fresh[following.source] | following.fresh
        return Edit(self.source[following.source], fresh, replaced | dict(following.replaced))


def keep(mask: Tensor) -> Edit:
    """Keeps the Gaussians where `mask` [N] is true, in their order."""
    source = mask.nonzero().squeeze(1)
    return Edit(source, torch.zeros_like(source, dtype=torch.bool))


def clone(count: int, index: Tensor) -> Edit:
    """Keeps all `count` Gaussians and appends a copy of each one in `index` [I]."""
    everything = torch.arange(count, device=index.device)
    source = torch.cat([everything, index])
    return Edit(source, torch.arange(source.shape[0], device=index.device) >= count)


@torch.no_grad()
def split(
    gaussians: Gaussians, index: Tensor, *, generator: torch.Generator, children: int = 2, shrink: float = 1.6
) -> Edit:
    """Replaces each Gaussian in `index` [I] by smaller ones drawn from it (3DGS, Section 5.2).

    The survivors come first, in their order; then the first child of every parent, the second of
    every parent, and so on.

    Args:
        gaussians: the set that is edited.
        index: rows to split, each at most once.
        generator: source of the children's positions, on the device of `gaussians`.
        children: how many take the place of one parent.
        shrink: factor by which a child's axes are shorter than its parent's.
    """
    count = len(gaussians)
    survives = torch.ones(count, dtype=torch.bool, device=index.device)
    survives[index] = False
    parents = index.repeat(children)
    source = torch.cat([survives.nonzero().squeeze(1), parents])
    fresh = torch.arange(source.shape[0], device=index.device) >= count - index.shape[0]

    means, log_scales = gaussians.means[source], gaussians.log_scales[source]
    means[fresh] += _drawn_offsets(gaussians.quats[parents], gaussians.deviations[parents], generator)
    log_scales[fresh] -= math.log(shrink)
    return Edit(source, fresh, {"means": means, "log_scales": log_scales})


def _drawn_offsets(quats: Tensor, deviations: Tensor, generator: torch.Generator) -> Tensor:
    """[N, 3] one random offset from the centre of each Gaussian, distributed as the Gaussian."""
    unit = torch.randn(deviations.shape, generator=generator, dtype=deviations.dtype, device=deviations.device)
    return (rotation_from_quat(quats) @ (unit * deviations)[..., None]).squeeze(-1)


@torch.no_grad()
def apply_edit(
    gaussians: Gaussians, moments: Moments, edit: Edit, *, part: str = "primary"
) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
    """The edited Gaussians and moments; nothing is changed in place and nothing requires a gradient.

    Args:
        gaussians: the set that is edited.
        moments: moments of any number of parameters; those of other scene parts pass through as
            they are, and a tensor without moments (not trained yet) stays without.
        edit: what to do.
        part: the scene part that `gaussians` is, first half of the names in `moments`.
    """
    edited = gaussians.with_tensors({name: edit.result(gaussians, name) for name in gaussians.tensors()})

    def moved(moment: Tensor) -> Tensor:
        rows = moment[edit.source]
        rows[edit.fresh] = 0
        return rows

    owned = {f"{part}.{name}" for name in gaussians.tensors()}
    return edited, {name: (moved(m), moved(v)) if name in owned else (m, v) for name, (m, v) in moments.items()}


@torch.no_grad()
def append(
    gaussians: Gaussians, moments: Moments, new: Gaussians, *, part: str = "primary"
) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
    """The Gaussians followed by `new` ones, whose moments are zero.

    Raises:
        ValueError: the two sets do not hold the same tensors.
    """
    old_tensors, new_tensors = gaussians.tensors(), new.tensors()
    if set(old_tensors) != set(new_tensors):
        raise ValueError(f"cannot append Gaussians with {sorted(new_tensors)} to Gaussians with {sorted(old_tensors)}")
    joined = gaussians.with_tensors({name: torch.cat([old_tensors[name], new_tensors[name]]) for name in old_tensors})

    def extended(name: str, moment: Tensor) -> Tensor:
        return torch.cat([moment, torch.zeros_like(new_tensors[name.removeprefix(f"{part}.")])])

    owned = {f"{part}.{name}" for name in old_tensors}
    return joined, {
        name: (extended(name, m), extended(name, v)) if name in owned else (m, v) for name, (m, v) in moments.items()
    }


@torch.no_grad()
def forget(moments: Moments, names: Collection[str], rows: Tensor | None = None) -> dict[str, tuple[Tensor, Tensor]]:
    """The moments with those of some parameters zeroed, because their values were replaced.

    Args:
        moments: moments by dotted parameter name.
        names: dotted names of the replaced parameters; names without moments are passed over.
        rows: boolean mask or indices of the replaced rows; all rows if None.
    """

    def cleared(moment: Tensor) -> Tensor:
        remaining = moment.clone()
        remaining[... if rows is None else rows] = 0
        return remaining

    return {name: (cleared(m), cleared(v)) if name in names else (m, v) for name, (m, v) in moments.items()}
