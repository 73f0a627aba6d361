"""What the values of a record read from a file have to be: types and ranges, declared once and checked in one place.

A table of fields checks a JSON object:

    SCENE = {"extent": Number(above=0), "active_sh_degree": Whole(0, 3), "files": Optional(Items(Text()), ())}
    header = checked(read_json(path), SCENE, str(path))
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

LARGEST_SHOWN = 80
LEAST_WHOLE, MOST_WHOLE = -(2**63), 2**63 - 1
LARGEST_COORDINATE = 1e12
"""World units. The square of a greater one, and what is summed up of them, does not fit float32."""


class Field(Protocol):
    """What one value has to be."""

    @property
    def expected(self) -> str:
        """For messages, as in "expected a number"."""
        ...

    def read(self, value: Any, where: str) -> Any:
        """The value, in the type that the program uses.

        Raises:
            ValueError: it is something else; names `where` it was found.
        """
        ...


@dataclass(frozen=True)
class Number:
    """A finite number, from `least` to `most`, or above `above`; read as float."""

    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf

    @property
    def expected(self) -> str:
        """For messages."""
        return "a finite number" + _range_text(self.least, self.most, self.above)

    def read(self, value: Any, where: str) -> float:
        """Refuses text and truth values too."""
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or not (_is_finite(value) and self.least <= value <= self.most and value > self.above):
            raise mismatch(value, where, self)
        return float(value)


@dataclass(frozen=True)
class Whole:
    """A whole number from `least` to `most`; read as int."""

    least: int = LEAST_WHOLE
    most: int = MOST_WHOLE

    @property
    def expected(self) -> str:
        """For messages."""
        return "a whole number" + _range_text(self.least, self.most)

    def read(self, value: Any, where: str) -> int:
        """Refuses 2.0 and true too."""
        if not isinstance(value, int) or isinstance(value, bool) or not self.least <= value <= self.most:
            raise mismatch(value, where, self)
        return value


@dataclass(frozen=True)
class Flag:
    """True or false."""

    expected: str = "true or false"

    def read(self, value: Any, where: str) -> bool:
        """Refuses 0 and 1 too."""
        if not isinstance(value, bool):
            raise mismatch(value, where, self)
        return value


@dataclass(frozen=True)
class Text:
    """A text that is not empty."""

    expected: str = "a text that is not empty"

    def read(self, value: Any, where: str) -> str:
        """The text as it is."""
        if not isinstance(value, str) or not value:
            raise mismatch(value, where, self)
        return value


@dataclass(frozen=True)
class Choice:
    """One of a few values."""

    choices: tuple[Any, ...]

    @property
    def expected(self) -> str:
        """For messages."""
        return f"one of {', '.join(map(repr, self.choices))}"

    def read(self, value: Any, where: str) -> Any:
        """1 is not true here."""
        if not any(value == choice and type(value) is type(choice) for choice in self.choices):
            raise mismatch(value, where, self)
        return value


@dataclass(frozen=True)
class Items:
    """A list of values of one kind, of `count` of them if that is given; read as a tuple."""

    item: Field
    count: int | None = None

    @property
    def expected(self) -> str:
        """For messages."""
        count = "" if self.count is None else f"{self.count} "
        return f"a list of {count}values, each {self.item.expected}"

    def read(self, value: Any, where: str) -> tuple[Any, ...]:
        """Names the entry that is wrong, counted from 1."""
        if not isinstance(value, (list, tuple)) or self.count not in (None, len(value)):
            raise mismatch(value, where, self)
        return tuple(self.item.read(one, f"entry {index} of {where}") for index, one in enumerate(value, start=1))


@dataclass(frozen=True)
class ByName:
    """An object that maps any names to values of one kind; read as a dictionary."""

    item: Field

    @property
    def expected(self) -> str:
        """For messages."""
        return f"an object whose values are each {self.item.expected}"

    def read(self, value: Any, where: str) -> dict[str, Any]:
        """Names the value that is wrong."""
        if not isinstance(value, dict):
            raise mismatch(value, where, self)
        return {name: self.item.read(one, f"{name!r} of {where}") for name, one in value.items()}


@dataclass(frozen=True)
class Nullable:
    """A value of some kind, or null."""

    field: Field

    @property
    def expected(self) -> str:
        """For messages."""
        return f"{self.field.expected}, or null"

    def read(self, value: Any, where: str) -> Any:
        """None for null."""
        return None if value is None else self.field.read(value, where)


@dataclass(frozen=True)
class Optional:
    """A value of some kind under a key that may be missing, which means `default`."""

    field: Field
    default: Any = None

    @property
    def expected(self) -> str:
        """For messages."""
        return self.field.expected

    def read(self, value: Any, where: str) -> Any:
        """The value where there is one."""
        return self.field.read(value, where)


def checked(value: Any, fields: Mapping[str, Field], where: str) -> dict[str, Any]:
    """The fields of an object, each as its entry of the table says; keys that the table does not know are left out.

    Args:
        value: what was read.
        fields: what has to be under each key; one that is `Optional` may be missing.
        where: names the object in messages.

    Raises:
        ValueError: no object, a key that is missing, or a value of another type or out of range.
    """
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {shown(value)}; expected an object with {', '.join(fields)}")
    found = {}
    for key, field in fields.items():
        if key in value:
            found[key] = field.read(value[key], f"{key} of {where}")
        elif isinstance(field, Optional):
            found[key] = field.default
        else:
            raise ValueError(f"{where} has no {key}; expected {field.expected}")
    return found


def mismatch(value: Any, where: str, field: Field) -> ValueError:
    """The error of a value that is not what was expected."""
    return ValueError(f"{where} is {shown(value)}; expected {field.expected}")


def shown(value: Any) -> str:
    """A value for a message, cut short."""
    text = repr(value)
    return text if len(text) <= LARGEST_SHOWN else f"{text[:LARGEST_SHOWN]}..."


def _is_finite(value: float) -> bool:
    """Also for whole numbers beyond the range of floats, which `math.isfinite` cannot take."""
    return -1.7e308 < value < 1.7e308


def _range_text(least: float, most: float, above: float = -math.inf) -> str:
    """The range of a number, for messages; the ends of 64 bits go without saying."""
    is_above, has_least, has_most = above > -math.inf, least > LEAST_WHOLE, most < MOST_WHOLE
    if has_least and has_most:
        return f" from {least:g} to {most:g}"
    lower = f" above {above:g}" if is_above else f" of at least {least:g}" if has_least else ""
    upper = f" of at most {most:g}" if has_most else ""
    return lower + (" and" if lower and upper else "") + upper


COORDINATE = Number(-LARGEST_COORDINATE, LARGEST_COORDINATE)
"""One component of a position in the world."""
