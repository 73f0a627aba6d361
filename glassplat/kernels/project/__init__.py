"""Projects Gaussians onto the screens of a batch of cameras."""

from glassplat.kernels.project.operation import GradientSum, project

__all__ = ["GradientSum", "project"]
