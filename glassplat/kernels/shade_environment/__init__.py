"""Deferred shading of blended surfaces with what they mirror."""

from glassplat.kernels.shade_environment.operation import shade_environment

__all__ = ["shade_environment"]
