"""Front-to-back blending of splats into images, with a second transmittance for the glass mask."""

from glassplat.kernels.composite.operation import Composite, composite

__all__ = ["Composite", "composite"]
