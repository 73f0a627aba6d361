"""What the values of options may be: declared in the annotation of a field, checked by `glassplat.data.options`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import tyro

MOST = 1_000_000_000
"""Of anything that is counted: more than a machine holds, and few enough for every integer type."""


@runtime_checkable
class Requirement(Protocol):
    """What the annotation of a field may say of its values; `allows` is asked about values of the annotated type."""

    def allows(self, value: Any) -> bool:
        """Whether the value will do."""
        ...

    @property
    def expected(self) -> str:
        """What is expected, as the end of a message."""
        ...


@dataclass(frozen=True)
class Range:
    """Bounds of a number.

    Attributes:
        low: the smallest one.
        high: the largest one.
        above: the number has to be larger than this.
        below: the number has to be smaller than this.
    """

    low: float | None = None
    high: float | None = None
    above: float | None = None
    below: float | None = None

    def allows(self, value: float) -> bool:
        """Whether the number is within the bounds; NaN never is."""
        return (
            value == value
            and (self.low is None or value >= self.low)
            and (self.high is None or value <= self.high)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    @property
    def expected(self) -> str:
        """The bounds in words."""
        if self.low is not None and self.high is not None:
            return f"from {self.low} to {self.high}"
        bounds = ((">=", self.low), (">", self.above), ("<=", self.high), ("<", self.below))
        return " and ".join(f"{sign} {bound}" for sign, bound in bounds if bound is not None) or "that is finite"


@dataclass(frozen=True)
class Ascending:
    """Numbers that get no smaller."""

    def allows(self, value: Sequence[float]) -> bool:
        """Whether they are in order."""
        return list(value) == sorted(value)

    @property
    def expected(self) -> str:
        """The order in words."""
        return "in ascending order"


Finite = Annotated[float, Range()]
"""Any number but NaN and infinity, which no option may be."""
Positive = Annotated[float, Range(above=0)]
NotNegative = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1)]
"""A part of a whole, nothing and everything included."""
PositiveShare = Annotated[float, Range(above=0, high=1)]
InnerShare = Annotated[float, Range(above=0, below=1)]
"""Of what is stored as a logit, which 0 and 1 do not have."""
LearningRate = Annotated[float, Range(0, 1)]
"""Of Adam, which moves a raw parameter by about so much at every step; 0 keeps it as it is."""
Count = Annotated[int, Range(0, MOST)]
Several = Annotated[int, Range(1, MOST)]
Downscale = Annotated[float, Range(1, 1000)]
"""Of photographs: width and height are divided by it."""
Seed = Annotated[int, Range(0, 2**32 - 1)]
ShDegree = Annotated[int, Range(0, 3)]
PaneLabel = Annotated[int, Range(1, 255)]
"""What a pixel of a mask can hold; 0 is no pane."""
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
"""The axis of the world that points up."""
Color = tuple[Share, Share, Share]
"""sRGB."""


class Essential(NamedTuple):
    """Marks an option that many runs need; `--help` shows these, `--help-advanced` all."""


ESSENTIAL = Essential()

T = TypeVar("T")
Internal = Annotated[T, tyro.conf.Fixed, tyro.conf.Suppress]
"""A value that recipes hold and the command line does not set: a constant of a method, or what its preset decides."""
