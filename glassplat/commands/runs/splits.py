"""Which of a run's photographs a command is about."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from glassplat.data.errors import InputError

if TYPE_CHECKING:
    from glassplat.data.dataset import Dataset
    from glassplat.data.view import View

Split = Literal["train", "test", "all"]


def chosen_views(dataset: Dataset, split: Split) -> tuple[View, ...]:
    """The views of a split, by name.

    Raises:
        InputError: there are none.
    """
    parts = {"train": dataset.train, "test": dataset.test, "all": (*dataset.train, *dataset.test)}
    if not parts[split]:
        raise InputError(f"{dataset.root} has no {split} views; choose another --split")
    return tuple(sorted(parts[split], key=lambda view: view.name))
