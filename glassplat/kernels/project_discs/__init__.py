"""Projects discs onto the screens of a batch of cameras."""

from glassplat.kernels.project_discs.operation import project_discs

__all__ = ["project_discs"]
