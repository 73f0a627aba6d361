"""Projects Gaussians onto the screens of a batch of cameras."""

from glassplat.kernels.project.operation import project

__all__ = ["project"]
