"""Traces rays through Gaussians."""

from glassplat.kernels.trace.operation import trace
from glassplat.kernels.trace.records import Bvh, Rays, Traced

__all__ = ["Bvh", "Rays", "Traced", "trace"]
