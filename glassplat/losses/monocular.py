"""How far normals are from those that were estimated from single photographs (EnvGS, Eq. 9)."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import torch
from torch import Tensor

from glassplat.data.dataset import View
from glassplat.data.normal_maps import FOLDER, estimated_normals
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene
from glassplat.scene.transfer import moved

log = logging.getLogger("glassplat.train")


@dataclass(frozen=True)
class MonocularNormals:
    """The mean of 1 - n . N_m over the pixels of an image, n the blended normal made unit, N_m the estimated one.

    Pixels without an estimate, or that show nothing, count as 0; a view without a file of normals has no such term.
    Files are read once.
    """

    _known: dict[str, Tensor | None] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __call__(self, frame: Frame, view: View, scene: Scene) -> Tensor | None:
        """The loss of a view; None where no normals lie beside its photograph."""
        if view.name not in self._known:
            self._known[view.name] = estimated_normals(view)
            if self._known[view.name] is None and (view.image_path.parent.parent / FOLDER).is_dir():
                log.warning("no normals for %s in the folder %r beside it: it is learned without", view.name, FOLDER)
        estimated = self._known[view.name]
        if estimated is None:
            return None
        estimated = moved(estimated, frame.rgb.device).to(frame.rgb)
        known = (estimated.square().sum(-1) > 0) & (frame.layers["alpha"].detach() > 0.5)
        blended = torch.nn.functional.normalize(frame.layers["normal"], dim=-1)
        return (known * (1 - (blended * estimated).sum(-1))).mean()
