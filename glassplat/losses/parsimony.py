"""Keeping the primary Gaussians transparent, small and evenly coloured unless the photographs need them otherwise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from glassplat.data.dataset import View
from glassplat.kernels.harmonic_energy import harmonic_energy
from glassplat.losses.term import LossFunction
from glassplat.render.frame import Frame
from glassplat.scene import transfer
from glassplat.scene.scene import Scene


def mean_opacity(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Opacity regularisation L_o (TR-Gaussians, Eq. 20): the L1 norm of the opacities, per Gaussian in view.

    Differentiable in the raw opacities. What no photograph holds up fades until it is relocated. Those that the view
    does not show are left out, unlike in the papers: what few views show would fade in all the others. Mirror images
    do not count: what a pane shows at a tenth of its strength would fade as fast as what is seen directly.
    """
    return _direct_mean(scene.primary.logit_opacities, torch.sigmoid, frame)


def mean_scale(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Covariance regularisation L_Sigma (TR-Gaussians, Eq. 20): the L1 norm of its eigenvalues' roots, per axis.

    Those roots are the standard deviations. Divided by the scene extent, so that the weight does not depend on the
    capture's units. Differentiable in the raw scales. Of what the view shows directly, as `mean_opacity`.
    """
    return _direct_mean(scene.primary.log_scales, torch.exp, frame) / scene.extent


def of_all(term: LossFunction) -> LossFunction:
    """A term of what the view shows directly, as one of all Gaussians."""
    return lambda frame, view, scene: term(replace(frame, direct=None), view, scene)


def view_dependence(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Squares of the spherical harmonics beyond the constant one, per Gaussian (not in the papers).

    What is seen from few directions has coefficients that no photograph decides, and its colour from other directions,
    from which a pane shows it, is whatever they happen to be.
    """
    sh = scene.primary.sh
    return harmonic_energy(sh) / max(sh.shape[0], 1)


def _direct_mean(values: Tensor, activation: Callable[[Tensor], Tensor], frame: Frame) -> Tensor:
    """Mean of the activated `values` [N, ...] of what the frame shows directly; of all if it does not say."""
    if frame.direct is None or not transfer.waits(values.device):
        chosen = activation(values if frame.direct is None else values[frame.direct])
        return chosen.sum() / max(chosen.numel(), 1)
    # How many there are, only the GPU knows: they are not gathered but all others left out.
    shown = frame.direct.reshape(-1, *[1] * (values.dim() - 1))
    total = torch.where(shown, activation(torch.where(shown, values, 0)), 0).sum()
    return total / (frame.direct.sum() * math.prod(values.shape[1:])).clamp(min=1)
