"""The best reconstruction that a few attempts give: usual settings first, more features where these do not do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from glassplat.data.errors import InputError, first_names
from glassplat.prepare.feature_database import FeatureDatabase, Features, Lens
from glassplat.prepare.mapping import Mapper, Mapping, placed
from glassplat.prepare.messages import Listener, Note
from glassplat.prepare.pairs import chosen_pairs
from glassplat.prepare.photographs import Photograph

FEWEST_FEATURES = 50
"""Of the middle photograph; with fewer nothing can be matched."""
ENOUGH = 0.95
"""Share of the photographs placed with which no further attempt is made."""


@dataclass(frozen=True)
class Attempt:
    """Settings of one attempt; `name` ends "trying again with"."""

    name: str
    features: Features
    mapping: Mapping


USUAL = Features(most=4096, least_contrast=1 / 150)
MANY = Features(most=12_000, least_contrast=1 / 600, guided=True)
ATTEMPTS = (
    Attempt("the usual settings", USUAL, Mapping()),
    Attempt("lower demands on what a photograph has to share with others", USUAL, Mapping(8, 20)),
    Attempt("three times the features, weak ones too", MANY, Mapping()),
    Attempt("many features and lower demands", MANY, Mapping(8, 20)),
)


@dataclass(frozen=True)
class Solution:
    """The groups that one attempt placed.

    Attributes:
        database: of the attempt.
        models: `pycolmap.Reconstruction`, the largest first; photographs in different ones share nothing.
        attempt: its name.
        tried: how many attempts were made.
    """

    database: FeatureDatabase
    models: Sequence[Any]
    attempt: str
    tried: int

    @property
    def registered(self) -> int:
        """Photographs in the largest group."""
        return int(self.models[0].num_reg_images()) if self.models else 0

    def group(self, number: int) -> list[Photograph]:
        """The photographs of one model, by their numbers."""
        return [self.database.photographs[index] for index in sorted(image_numbers(self.models[number]))]

    def missing(self) -> list[Photograph]:
        """The photographs that are not in the largest group."""
        known = set(image_numbers(self.models[0])) if self.models else set()
        return [one for index, one in enumerate(self.database.photographs) if index not in known]


@dataclass(frozen=True)
class Settings:
    """How photographs are placed.

    Attributes:
        lens: COLMAP's camera model.
        mapper: one photograph after the other, or all at once.
        threads: to use.
    """

    lens: Lens = "simple_radial"
    mapper: Mapper = "incremental"
    threads: int = -1


def image_numbers(model: Any) -> dict[int, Any]:
    """The placed images of a model by the number of their photograph."""
    return {int(Path(image.name).stem): image for image in model.images.values() if image.has_pose}


def best_solution(photographs: Sequence[Photograph], work: Path, settings: Settings, listen: Listener) -> Solution:
    """Places photographs, with as many attempts as it takes; what lies in `work` from before is used.

    Raises:
        InputError: the photographs show too little to be recognised.
    """
    best: Solution | None = None
    for number, attempt in enumerate(ATTEMPTS, start=1):
        if best is not None:
            told = f"{best.registered} of {len(photographs)} photographs were placed; trying again with {attempt.name}"
            listen(Note(told))
        database = _matched(photographs, work, attempt.features, settings, listen)
        models = placed(
            database.path,
            settings.mapper,
            attempt.mapping,
            count=len(photographs),
            listen=listen,
            threads=settings.threads,
        )
        found = Solution(database, models, attempt.name, number)
        if best is None or found.registered > best.registered:
            best = found
        if best.registered >= ENOUGH * len(photographs):
            break
    assert best is not None
    return Solution(best.database, best.models, best.attempt, number)


def _matched(
    photographs: Sequence[Photograph], work: Path, features: Features, settings: Settings, listen: Listener
) -> FeatureDatabase:
    """The database of these features, with every pair matched that is worth it."""
    database = FeatureDatabase(work / f"features-{features.most}.db", work / "grey", photographs)
    database.write_pictures(listen)
    database.create(settings.lens)
    database.extract(features, listen, settings.threads)
    _check_texture(database)
    database.match(chosen_pairs(database.descriptors()), features, listen, settings.threads)
    return database


def _check_texture(database: FeatureDatabase) -> None:
    counts = database.feature_counts()
    poor = [one.path.name for one, count in zip(database.photographs, counts, strict=True) if count < FEWEST_FEATURES]
    if 2 * len(poor) > len(counts):
        raise InputError(
            f"{len(poor)} of {len(counts)} photographs show fewer than {FEWEST_FEATURES} places that could be "
            f"recognised ({first_names(poor)}): they are blurred, dark or without texture. Photograph with more light, "
            "hold still, and let things with texture be in the picture, such as the pane's surroundings"
        )
