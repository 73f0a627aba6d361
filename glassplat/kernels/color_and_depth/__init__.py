"""The image and the mean depths of what was blended, over a background."""

from glassplat.kernels.color_and_depth.operation import color_and_depth
from glassplat.kernels.color_and_depth.reference import mean_depth

__all__ = ["color_and_depth", "mean_depth"]
