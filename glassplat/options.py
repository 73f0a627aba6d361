"""Options as dataclasses: ranges in annotations, checked from the command line and from JSON.

Annotations define valid values: type, `Literal` choices, and requirements such as `Range`. A dataclass with
dependencies between fields has a method `contradiction`.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import tyro

from glassplat.errors import InputError

LARGEST_COUNT = 1_000_000_000
"""Maximum of all counts: more than a machine holds, and small enough for every integer type."""


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
        """Return whether the number is within the bounds; NaN never is."""
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
    """Numbers in ascending order."""

    def allows(self, value: Sequence[float]) -> bool:
        """Return whether they are in ascending order."""
        return list(value) == sorted(value)

    @property
    def expected(self) -> str:
        """The order in words."""
        return "in ascending order"


Requirement = Range | Ascending
"""Requirement in the annotation of a field, for values of the annotated type."""

LARGEST_COORDINATE = 1e12
"""World units; squares of larger values, and sums of these, may exceed float32."""
Coordinate = Annotated[float, Range(-LARGEST_COORDINATE, LARGEST_COORDINATE)]
Length = Annotated[float, Range(above=0, high=LARGEST_COORDINATE)]
Angle = Annotated[float, Range(-360, 360)]
"""Degrees."""
Positive = Annotated[float, Range(above=0)]
NonNegative = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1)]
"""A share, from 0 to 1."""
PositiveShare = Annotated[float, Range(above=0, high=1)]
OpenShare = Annotated[float, Range(above=0, below=1)]
"""A share stored as a logit, without 0 and 1."""
LearningRate = Annotated[float, Range(0, 1)]
"""Learning rate of Adam, about the change of a raw parameter per step; 0 freezes it."""
Count = Annotated[int, Range(0, LARGEST_COUNT)]
PositiveCount = Annotated[int, Range(1, LARGEST_COUNT)]
Downscale = Annotated[float, Range(1, 1000)]
"""Factor by which width and height of photographs are divided."""
Seed = Annotated[int, Range(0, 2**32 - 1)]
ShDegree = Annotated[int, Range(0, 3)]
PaneLabel = Annotated[int, Range(1, 255)]
"""Label of a pane in masks; 0 is no pane."""
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
"""The axis of the world that points up."""
Color = tuple[Share, Share, Share]
"""sRGB."""


class Essential(NamedTuple):
    """Marks a common option; `--help` shows these, `--help-advanced` all."""


ESSENTIAL = Essential()

T = TypeVar("T")
Internal = Annotated[T, tyro.conf.Fixed, tyro.conf.Suppress]
"""A value of recipes that the command line does not set: a constant of a method, or part of its preset."""

LONGEST_SHOWN = 80
"""Maximum length of a wrong value in messages."""
UNION_TYPES = (typing.Union, types.UnionType)
SCALAR_NAMES = {bool: "True or False", int: "a whole number", float: "a number", str: "a text", Path: "a path"}
"""Types of single values, and their names in messages."""


class OptionError(InputError):
    """An invalid value; the name is that of the field, dotted for nested fields."""

    def __init__(self, name: str, value: Any, expected: str) -> None:
        super().__init__(f"{name or 'the value'} is {short_repr(value)}; expected {expected}")
        self.name, self.value, self.expected = name, value, expected


def check_options(options: Any) -> None:
    """Checks a command or a recipe, including nested options.

    Raises:
        InputError: a value is out of range, or values contradict each other; the message names the option.
    """
    try:
        check_value(type(options), options)
    except OptionError as error:
        raise InputError(f"{as_option(error.name)} is {short_repr(error.value)}; expected {error.expected}") from error


def as_option(name: str) -> str:
    """The option of the command line that sets a field: `plane_fit.seed` is `--plane-fit.seed`."""
    return "--" + name.replace("_", "-")


def check_value(hint: Any, value: Any, name: str = "") -> Any:
    """The value converted to the type of its annotation, if valid.

    Args:
        hint: annotation of a field, or a dataclass.
        value: a value of this type, or its JSON form; missing fields of a dataclass get their defaults.
        name: name of the field, for messages.

    Raises:
        InputError: the value is invalid, or a field is unknown or missing; the message names it.
    """
    hint, requirements = unwrap_annotation(hint)
    result = _convert_value(hint, value, name, requirements)
    for requirement in requirements:
        if result is not None and not requirement.allows(result):
            raise OptionError(name, value, expectation(hint, requirements))
    return result


def unwrap_annotation(hint: Any) -> tuple[Any, tuple[Requirement, ...]]:
    """An annotation without metadata, and its requirements."""
    if typing.get_origin(hint) is not typing.Annotated:
        return hint, ()
    inner, *metadata = typing.get_args(hint)
    return inner, tuple(data for data in metadata if isinstance(data, Requirement))


def expectation(hint: Any, requirements: tuple[Requirement, ...] = ()) -> str:
    """Expected value of this annotation, in words."""
    bounds = " and ".join(requirement.expected for requirement in requirements)
    if hint in SCALAR_NAMES:
        return f"{SCALAR_NAMES[hint]} {bounds}".rstrip()
    return ", ".join(filter(None, (_expected_structure(hint), bounds)))


def _expected_structure(hint: Any) -> str:
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin is tuple:
        if inner[-1] is ...:
            return f"any number of values, each {expectation(*unwrap_annotation(inner[0]))}"
        kinds = dict.fromkeys(expectation(*unwrap_annotation(part)) for part in inner)
        each = f"each {next(iter(kinds))}" if len(kinds) == 1 else f"out of: {'; '.join(kinds)}"
        return f"{len(inner)} values, {each}"
    return "an object with named values"


def _convert_value(hint: Any, value: Any, name: str, requirements: tuple[Requirement, ...]) -> Any:
    """The value converted to a type without metadata; requirements are for the message."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _to_dataclass(type(value), {field.name: getattr(value, field.name) for field in fields(value)}, name)
    if dataclasses.is_dataclass(hint):
        return _to_dataclass(typing.cast(type, hint), value, name)
    origin = typing.get_origin(hint)
    if origin in UNION_TYPES:
        return _to_optional(hint, value, name)
    if origin in CONVERTERS:
        return CONVERTERS[origin](hint, value, name)
    if not _has_type(hint, value):
        raise OptionError(name, value, expectation(hint, requirements))
    return hint(value) if hint in (float, Path) else value


def _has_type(hint: Any, value: Any) -> bool:
    """Return whether a value has a type; integers are floats, too, but booleans and infinity are not."""
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and is_finite(value)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint is Path:
        return isinstance(value, (str, Path))
    return isinstance(value, hint)


def is_finite(value: float) -> bool:
    """Return whether a number is finite and representable as a float."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def _to_dataclass(kind: type, value: Any, name: str) -> Any:
    """An instance of a dataclass from its fields by name."""
    if not isinstance(value, Mapping):
        raise OptionError(name, value, "an object with named values")
    hints = typing.get_type_hints(kind, include_extras=True)
    known = [field.name for field in fields(kind)]
    unknown = sorted(map(str, set(value) - set(known)))
    if unknown:
        raise InputError(f"unknown fields {unknown} of {name or 'the options'}; there are {known}")
    missing = [field.name for field in fields(kind) if _is_required(field) and field.name not in value]
    if missing:
        raise InputError(f"fields {missing} of {name or 'the options'} are missing")
    given = [key for key in known if key in value]
    values = {key: check_value(hints[key], value[key], nested_name(name, key, hints[key])) for key in given}
    instance = kind(**values)
    contradiction = instance.contradiction() if hasattr(instance, "contradiction") else None
    if contradiction:
        raise InputError(contradiction)
    return instance


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def nested_name(outer: str, field: str, hint: Any) -> str:
    """Dotted name of a nested field; fields without a name on the command line add nothing."""
    nameless = any(getattr(data, "name", None) == "" for data in typing.get_args(hint)[1:])
    return outer if nameless else f"{outer}.{field}".removeprefix(".")


def _to_optional(hint: Any, value: Any, name: str) -> Any:
    """None, or the value converted to the other type of the union."""
    if value is None:
        return None
    (kind,) = (option for option in typing.get_args(hint) if option is not type(None))
    try:
        return check_value(kind, value, name)
    except OptionError as error:
        # An error in a nested field is more specific.
        raise OptionError(error.name, error.value, f"{error.expected}, or None") from error


def _to_literal(hint: Any, value: Any, name: str) -> Any:
    choices = typing.get_args(hint)
    if not any(value == choice and type(value) is type(choice) for choice in choices):
        raise OptionError(name, value, f"one of {', '.join(map(str, choices))}")
    return value


def _to_tuple(hint: Any, value: Any, name: str) -> tuple[Any, ...]:
    inner = typing.get_args(hint)
    if not isinstance(value, (list, tuple)) or (inner[-1] is not ... and len(value) != len(inner)):
        raise OptionError(name, value, _expected_structure(hint))
    kinds = inner[:1] * len(value) if inner[-1] is ... else inner
    try:
        return tuple(check_value(kind, element, name) for kind, element in zip(kinds, value, strict=True))
    except OptionError as error:
        raise OptionError(name, value, _expected_structure(hint)) from error


def _to_dict(hint: Any, value: Any, name: str) -> dict[Any, Any]:
    keys, values = typing.get_args(hint)
    if not isinstance(value, Mapping):
        raise OptionError(name, value, _expected_structure(hint))
    return {check_value(keys, key, name): check_value(values, element, name) for key, element in value.items()}


CONVERTERS: dict[Any, Callable[[Any, Any, str], Any]] = {typing.Literal: _to_literal, tuple: _to_tuple, dict: _to_dict}


def short_repr(value: Any) -> str:
    """A value for a message, cut short."""
    try:
        text = repr(value) if isinstance(value, str) else str(value)
    except ValueError:  # An integer with too many digits to print.
        text = "a number of thousands of digits"
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


Rgb = tuple[float, float, float]
"""sRGB in [0, 1]."""
WHITE: Rgb = (1.0, 1.0, 1.0)
BLACK: Rgb = (0.0, 0.0, 0.0)
"""Default background."""
CLEAR_GLASS = 0.0817
"""R0 of a clear pane: 2 r / (1 + r) with r = ((n - 1) / (n + 1))^2 for each of its surfaces, n = 1.52."""

Blend = Literal["srgb", "linear"]
"""The space in which transmission and reflection are blended: sRGB or linear radiance."""


@dataclass(frozen=True)
class Cleaning:
    """Rules for Gaussians to remove; panes, their glass and the environment stay.

    Attributes:
        box: two opposite corners, in world units; Gaussians centred outside are removed.
        isolated: distance to the fourth neighbour, in multiples of a Gaussian's size (or of the median size, if
            larger), above which it is removed; 0 keeps all.
        oversized: standard deviation, as a share of the distance to the nearest camera, above which a Gaussian is
            removed; 0 keeps all.
    """

    box: tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate] | None = None
    isolated: NonNegative = 8.0
    oversized: NonNegative = 1.0
