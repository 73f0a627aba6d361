"""Floaters: Gaussians outside a box, far from all others, or large relative to their distance from a camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from glassplat.errors import InputError
from glassplat.options import Cleaning
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene

NEIGHBOURS = 4
"""Neighbour whose distance is measured; the first ones are too near, because floaters come in twos and threes."""


class Floaters:
    """Sizes and distances of a scene's Gaussians, measured once for trying several rules."""

    def __init__(self, gaussians: Gaussians, cameras: Tensor) -> None:
        """Measures sizes and distances.

        Args:
            gaussians: N of them.
            cameras: [V, 3] centres; at least one.

        Raises:
            InputError: there are no Gaussians.
        """
        if not len(gaussians):
            raise InputError("a scene without Gaussians cannot be cleaned; expected at least one")
        from scipy.spatial import cKDTree  # Slow to import, and rarely needed.

        self._gaussians = gaussians
        rows = [tensor.detach()[:, None].flatten(1) for tensor in gaussians.tensors().values()]
        finite = torch.stack([row.isfinite().all(dim=1) for row in rows]).all(dim=0).cpu()
        means = gaussians.means.detach().double().cpu()[finite].numpy()
        count = min(NEIGHBOURS, len(means) - 1)
        # Gaussians that are not finite count as isolated.
        distances = torch.full((2, len(gaussians)), torch.inf, dtype=torch.float64)
        if len(means):
            apart = cKDTree(means).query(means, k=count + 1, workers=-1)[0].reshape(len(means), -1)[:, -1]
            near = cKDTree(cameras.detach().double().cpu().numpy()).query(means)[0]
            distances[:, finite] = torch.from_numpy(np.stack([apart, near]))
        self._neighbour_distances, self._camera_distances = distances
        self._largest_scales = gaussians.log_scales.detach().double().cpu().amax(dim=1).exp().where(finite, 0)

    def masks(self, cleaning: Cleaning) -> dict[str, Tensor]:
        """[N] bool for each rule: the Gaussians it removes."""
        everywhere = torch.zeros(len(self._largest_scales), dtype=torch.bool)
        found = {"outside": everywhere, "isolated": everywhere, "oversized": everywhere}
        if cleaning.box is not None:
            corners = torch.tensor(cleaning.box, dtype=torch.float64).reshape(2, 3)
            means = self._gaussians.means.detach().double().cpu()
            found["outside"] = ((means < corners.amin(dim=0)) | (means > corners.amax(dim=0))).any(dim=1)
        if cleaning.isolated:
            scales = self._largest_scales.clamp(min=float(self._largest_scales.median()))
            found["isolated"] = self._neighbour_distances > cleaning.isolated * scales
        if cleaning.oversized:
            found["oversized"] = self._largest_scales > cleaning.oversized * self._camera_distances
        return found


def clean_scene(scene: Scene, floaters: Floaters, cleaning: Cleaning) -> tuple[Scene, dict[str, int]]:
    """The scene without the Gaussians selected by the rules, and their number for each rule.

    Args:
        scene: to be cleaned; it is not modified.
        floaters: of its primary Gaussians.
        cleaning: the rules.

    Raises:
        InputError: no Gaussian would be left.
    """
    found = floaters.masks(cleaning)
    kept = ~torch.stack(list(found.values())).any(dim=0)
    if not bool(kept.any()):
        raise InputError(f"nothing would be left of {len(kept)} Gaussians; expected a larger box, or looser limits")
    primary = scene.primary.select(kept.to(scene.primary.means.device))
    return replace(scene, primary=primary), {rule: int(gone.sum()) for rule, gone in found.items()}
