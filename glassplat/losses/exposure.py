"""What keeps the exposures of the photographs near the scene's own colours."""

from __future__ import annotations

from torch import Tensor

from glassplat.data.dataset import View
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene


def exposure_departure(frame: Frame, view: View, scene: Scene) -> Tensor | None:
    """Sum of squares of the view's own transform and, once for all, of the mean over the photographs.

    Without the second, the scene might be twice as bright and all photographs half as much; then views that no
    photograph shows would have the wrong colours.
    """
    own = scene.exposures.of(view.name)
    if own is None:
        return None
    return own.square().sum() / len(scene.exposures) + scene.exposures.affine.mean(dim=0).square().sum()
