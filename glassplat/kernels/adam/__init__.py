"""Adam, in place and in one pass, with a learning rate per column where wanted."""

from glassplat.kernels.adam.operation import adam

__all__ = ["adam"]
