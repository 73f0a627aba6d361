"""Keeping the primary Gaussians transparent, small and evenly coloured unless the photographs need them otherwise."""

from __future__ import annotations

from torch import Tensor

from glassplat.data.dataset import View
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene


def mean_opacity(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Opacity regularisation L_o (TR-Gaussians, Eq. 20): the L1 norm of the opacities, per Gaussian.

    Differentiable in the raw opacities. What no photograph holds up fades until it is relocated.
    """
    opacities = scene.primary.logit_opacities.sigmoid()
    return opacities.sum() / max(opacities.numel(), 1)


def mean_scale(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Covariance regularisation L_Sigma (TR-Gaussians, Eq. 20): the L1 norm of its eigenvalues' roots, per axis.

    Those roots are the standard deviations. Divided by the scene extent, so that the weight does not depend on the
    capture's units. Differentiable in the raw scales.
    """
    scales = scene.primary.log_scales.exp()
    return scales.sum() / max(scales.numel(), 1) / scene.extent


def view_dependence(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Squares of the spherical harmonics beyond the constant one, per Gaussian (not in the papers).

    What is seen from few directions has coefficients that no photograph decides, and its colour from other directions,
    from which a pane shows it, is whatever they happen to be.
    """
    higher = scene.primary.sh[:, 1:]
    return higher.square().sum() / max(higher.shape[0], 1)
