"""A weighted term of the objective."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from glassplat.data.dataset import View
from glassplat.render.frame import Frame
from glassplat.scene.scene import Scene

LossFunction = Callable[[Frame, View, Scene], Tensor | None]


@dataclass(frozen=True)
class LossTerm:
    """A named loss and its weight; the function returns None for a view to which it does not apply."""

    name: str
    weight: float
    function: LossFunction


def weighted(*terms: LossTerm) -> tuple[LossTerm, ...]:
    """The terms whose weight is not zero; the others are not even computed."""
    return tuple(term for term in terms if term.weight != 0)
