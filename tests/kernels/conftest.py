"""Random splats, drawn without the projection, for the tests of the operations that follow it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from glassplat.kernels.records import Splats

MakeSplats = Callable[..., Splats]


def _between(low: float, high: float, shape: Sequence[int], generator: torch.Generator) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


@pytest.fixture
def random_splats() -> MakeSplats:
    """Returns a function that draws random anisotropic splats [C, G] over an image."""

    def make(
        shape: tuple[int, int],
        image_size: tuple[int, int],
        *,
        dtype: torch.dtype = torch.float64,
        opacities: tuple[float, float] = (0.1, 0.9),
        sigmas: tuple[float, float] = (1.0, 8.0),
        seed: int = 0,
    ) -> Splats:
        generator = torch.Generator().manual_seed(seed)
        width, height = image_size
        means = _between(-5, 5, (*shape, 2), generator) + torch.rand(
            (*shape, 2), generator=generator, dtype=torch.float64
        ) * torch.tensor([width, height])
        log_sigmas = _between(math.log(sigmas[0]), math.log(sigmas[1]), (*shape, 2), generator)
        angles = _between(0, math.pi, shape, generator)
        cosine, sine = angles.cos(), angles.sin()
        axes = torch.stack([torch.stack([cosine, -sine], -1), torch.stack([sine, cosine], -1)], -2)
        covariances = axes @ torch.diag_embed((2 * log_sigmas).exp()) @ axes.mT + 0.3 * torch.eye(2)
        inverse = torch.linalg.inv(covariances)
        conics = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], dim=-1)
        opacity = _between(*opacities, shape, generator)
        reach = 2 * torch.log((255 * opacity).clamp(min=1))
        radii = (covariances.diagonal(dim1=-2, dim2=-1) * reach[..., None]).sqrt()
        depths = _between(1, 10, shape, generator)
        return Splats(*(tensor.to(dtype) for tensor in (means, conics, opacity, depths, radii)))

    return make
