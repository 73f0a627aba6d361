"""Leaving out what only one photograph shows: passers-by, cars, and their mirror images."""

from __future__ import annotations

from dataclasses import dataclass, replace

from glassplat.data.ranges import NotNegative, Share
from glassplat.losses.photometric import PhotometricLoss
from glassplat.losses.term import LossTerm
from glassplat.train.stage import Stage


@dataclass(frozen=True)
class Robustness:
    """Leaves pixels out of the photometric loss whose residuals are far above those of the rest of the photograph.

    After RobustNeRF (arXiv 2302.00833): what is not there in other photographs cannot be explained by a scene that
    stands still, and its residuals stay large over whole patches.

    Attributes:
        threshold: patches are left out whose mean residual is more than so many times the one that four of five patches
            of the photograph stay below; 0 leaves nothing out.
        start: share of the run before which all pixels count, because nothing is explained yet.
    """

    threshold: NotNegative = 0.0
    start: Share = 0.2

    def applied_to(self, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
        """The stages, of which that is cut in two within which patches begin to be left out."""
        if not self.threshold:
            return stages
        total, passed, found = sum(stage.share for stage in stages), 0.0, []
        for stage in stages:
            before = min(max(self.start * total - passed, 0.0), stage.share)
            passed += stage.share
            if before > 0:
                found.append(replace(stage, share=before))
            if before < stage.share:
                entry = stage.entry if before == 0 else None
                found.append(replace(stage, share=stage.share - before, entry=entry, losses=self._robust(stage)))
        return tuple(found)

    def _robust(self, stage: Stage) -> tuple[LossTerm, ...]:
        return tuple(
            replace(term, function=replace(term.function, outliers=self.threshold))
            if isinstance(term.function, PhotometricLoss)
            else term
            for term in stage.losses
        )
