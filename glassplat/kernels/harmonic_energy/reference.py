"""The definition of `glassplat.kernels.harmonic_energy.harmonic_energy`, in PyTorch."""

from __future__ import annotations

from torch import Tensor


def harmonic_energy(sh: Tensor) -> Tensor:
    """See `glassplat.kernels.harmonic_energy.harmonic_energy`."""
    return sh[:, 1:].square().sum()
