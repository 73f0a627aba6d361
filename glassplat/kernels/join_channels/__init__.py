"""What splats carry, side by side."""

from glassplat.kernels.join_channels.operation import join_channels

__all__ = ["join_channels"]
