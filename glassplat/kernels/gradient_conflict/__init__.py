"""Edges that two images share."""

from glassplat.kernels.gradient_conflict.operation import gradient_conflict

__all__ = ["gradient_conflict"]
