"""Builds the hierarchy of boxes through which rays find Gaussians."""

from glassplat.kernels.build_bvh.operation import build_bvh

__all__ = ["build_bvh"]
