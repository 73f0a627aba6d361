"""What each Gaussian adds to an image that is shaded after blending."""

from glassplat.kernels.surface_channels.operation import surface_channels

__all__ = ["surface_channels"]
