"""Spherical harmonics of things that were turned or mirrored."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.project.reference import sh_basis

DIRECTIONS = 64


def turned_harmonics(sh: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients of the same colours, on things that were turned: the colour along d was that along R^T d.

    Turning keeps each degree to itself, so a few directions determine the map between the coefficients exactly.

    Args:
        sh: [N, K, 3], K in {0, 1, 4, 9, 16}.
        rotation: [3, 3] orthogonal R, also that of a mirror.
    """
    count = sh.shape[1]
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(DIRECTIONS, 3, generator=generator, dtype=torch.float64))
    before, after = (sh_basis(rays)[:, :count] for rays in (directions, directions @ rotation.to(directions)))
    turn = torch.linalg.lstsq(before, after).solution
    return torch.einsum("jk,nkc->njc", turn.to(sh), sh)
