"""How much colours change with the direction of view."""

from glassplat.kernels.harmonic_energy.operation import harmonic_energy

__all__ = ["harmonic_energy"]
