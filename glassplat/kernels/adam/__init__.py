"""Adam, in place and in one pass over all parameters, with a learning rate per column where wanted."""

from glassplat.kernels.adam.operation import adam
from glassplat.kernels.adam.update import Update

__all__ = ["Update", "adam"]
