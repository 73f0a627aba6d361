"""JSON records from untrusted files: parsing, limits, and tables of fields.

Values are nested at most `DEEPEST` levels, all text is valid UTF-8, and no key of an object occurs twice. Integers have
at most `MOST_DIGITS` digits; longer ones become floats, which may be infinite.

A table of fields checks a JSON object:

    SCENE = {"extent": Number(above=0), "active_sh_degree": Integer(0, 3), "files": Optional(ListOf(Text()), ())}
    header = check_fields(read_json(path), SCENE, str(path))
"""

from __future__ import annotations

import json
import math
import os
import stat
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from glassplat.options import LARGEST_COORDINATE, is_finite, short_repr

LARGEST_TEXT = 2**28
"""Maximum bytes of a text file; a list of a hundred thousand photographs with poses takes a quarter of it."""


@contextmanager
def wrap_read_errors(path: Path) -> Iterator[None]:
    """Turns exceptions from opening or reading a file into errors that name the file and the cause."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise ValueError(f"{path} cannot be read (it is a folder, a pipe or a device); expected a file")
        yield
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path} does not exist; expected a file") from error
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"{path} cannot be read ({reason}); expected a file that may be read") from error


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, with or without a byte-order mark."""
    with wrap_read_errors(path):
        size = os.stat(path).st_size
        if size > LARGEST_TEXT:
            raise ValueError(f"{path} has {size} bytes; expected a text file of at most {LARGEST_TEXT}")
        data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not UTF-8 text ({error.reason} at byte {error.start}); save it as UTF-8"
        ) from error


DEEPEST, MOST_DIGITS = 32, 20
"""Maximum levels of nesting and digits of an integer, enough for every one of 64 bits."""


def read_json(path: Path) -> Any:
    """The contents of a JSON file."""
    return parse_json(read_text(path), str(path))


def parse_json(text: str, where: str) -> Any:
    """The value of a JSON text; `where` names the text in messages."""
    try:
        value = json.loads(text, parse_int=_parse_int, object_pairs_hook=_dict_without_duplicates)
    except RecursionError as error:
        raise ValueError(_too_deep(where)) from error
    except ValueError as error:
        raise ValueError(f"{where} is not valid JSON ({error}); it is damaged or cut off: write it again") from error
    _check_nesting_and_text(value, where)
    return value


def _parse_int(digits: str) -> int | float:
    return int(digits) if len(digits) <= MOST_DIGITS else float(digits)


def _dict_without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        ((repeated, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the key {repeated!r} occurs twice in one object")
    return found


def _check_nesting_and_text(value: Any, where: str) -> None:
    """Checks depth and text level by level, without recursion."""
    level = [value]
    for _ in range(DEEPEST):
        unprintable = next((text for text in level if isinstance(text, str) and not is_encodable(text)), None)
        if unprintable is not None:
            raise ValueError(f"{where} holds the text {unprintable!r}, which is not valid Unicode; write it again")
        level = [inner for outer in level for inner in _children(outer)]
        if not level:
            return
    raise ValueError(_too_deep(where))


def _children(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [*value.keys(), *value.values()]
    return value if isinstance(value, list) else []


def is_encodable(text: str) -> bool:
    """Return whether a text has no lone surrogates, which JSON allows, but file names and terminals do not."""
    return text.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in text)


def readable_name(path: Path | str) -> str:
    """A path as text for JSON; undecodable bytes are written in hexadecimal."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def _too_deep(where: str) -> str:
    return f"{where} is nested more than {DEEPEST} levels deep; expected a file written by a splatting program"


INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1
"""Range of integers of 64 bits."""


class Field:
    """Requirement for one value; `expected` is for messages, as in "expected a number"."""

    expected = "any value"

    def read(self, value: Any, where: str) -> Any:
        """Checks a value and converts it to the type that the program uses."""
        if not self._is_valid(value):
            raise ValueError(f"{where} is {short_repr(value)}; expected {self.expected}")
        return self._convert(value, where)

    def _is_valid(self, value: Any) -> bool:
        return True

    def _convert(self, value: Any, where: str) -> Any:
        return value


class Number(Field):
    """A finite number, from `least` to `most`, or above `above`; not a string or boolean; read as float."""

    def __init__(self, least: float = -math.inf, most: float = math.inf, above: float = -math.inf) -> None:
        self._least, self._most, self._above = least, most, above
        self.expected = "a finite number" + _range_text(least, most, above)

    def _is_valid(self, value: Any) -> bool:
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and is_finite(value)
        return is_number and self._least <= value <= self._most and value > self._above

    def _convert(self, value: Any, where: str) -> float:
        return float(value)


class Integer(Field):
    """An integer from `least` to `most`; 2.0 and true are refused."""

    def __init__(self, least: int = INT64_MIN, most: int = INT64_MAX) -> None:
        self._least, self._most = least, most
        self.expected = "a whole number" + _range_text(least, most)

    def _is_valid(self, value: Any) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and self._least <= value <= self._most


class Boolean(Field):
    """A boolean; 0 and 1 are refused."""

    expected = "true or false"

    def _is_valid(self, value: Any) -> bool:
        return isinstance(value, bool)


class Text(Field):
    """A non-empty string."""

    expected = "a text that is not empty"

    def _is_valid(self, value: Any) -> bool:
        return isinstance(value, str) and bool(value)


class Choice(Field):
    """One of a few values; types must match, so that 1 is not true."""

    def __init__(self, choices: tuple[Any, ...]) -> None:
        self._choices = choices
        self.expected = f"one of {', '.join(map(repr, choices))}"

    def _is_valid(self, value: Any) -> bool:
        return any(value == choice and type(value) is type(choice) for choice in self._choices)


class ListOf(Field):
    """A list of values of one kind, with `count` entries if given; read as a tuple."""

    def __init__(self, item: Field, count: int | None = None) -> None:
        self._item, self._count = item, count
        self.expected = f"a list of {'' if count is None else f'{count} '}values, each {item.expected}"

    def _is_valid(self, value: Any) -> bool:
        return isinstance(value, (list, tuple)) and self._count in (None, len(value))

    def _convert(self, value: Any, where: str) -> tuple[Any, ...]:
        return tuple(self._item.read(one, f"entry {index} of {where}") for index, one in enumerate(value, start=1))


class DictOf(Field):
    """An object that maps any names to values of one kind; read as a dictionary."""

    def __init__(self, item: Field) -> None:
        self._item, self.expected = item, f"an object whose values are each {item.expected}"

    def _is_valid(self, value: Any) -> bool:
        return isinstance(value, dict)

    def _convert(self, value: Any, where: str) -> dict[str, Any]:
        return {name: self._item.read(one, f"{name!r} of {where}") for name, one in value.items()}


class Nullable(Field):
    """A value of some kind, or null, which is read as None."""

    def __init__(self, field: Field) -> None:
        self._field, self.expected = field, f"{field.expected}, or null"

    def _convert(self, value: Any, where: str) -> Any:
        return None if value is None else self._field.read(value, where)


class Optional(Field):
    """A value of some kind under a key that may be missing, which means `default`."""

    def __init__(self, field: Field, default: Any = None) -> None:
        self._field, self.default, self.expected = field, default, field.expected

    def _convert(self, value: Any, where: str) -> Any:
        return self._field.read(value, where)


def check_fields(value: Any, fields: Mapping[str, Field], where: str) -> dict[str, Any]:
    """The fields of an object, checked and converted by a table; keys outside the table are left out.

    Args:
        value: the parsed JSON value.
        fields: requirement by key; `Optional` fields may be missing.
        where: names the object in messages.
    """
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {short_repr(value)}; expected an object with {', '.join(fields)}")
    found = {}
    for key, field in fields.items():
        if key in value:
            found[key] = field.read(value[key], f"{key} of {where}")
        elif isinstance(field, Optional):
            found[key] = field.default
        else:
            raise ValueError(f"{where} has no {key}; expected {field.expected}")
    return found


def _range_text(least: float, most: float, above: float = -math.inf) -> str:
    """The range of a number, for messages; 64-bit limits are omitted."""
    is_above, has_least, has_most = above > -math.inf, least > INT64_MIN, most < INT64_MAX
    if has_least and has_most:
        return f" from {least:g} to {most:g}"
    lower = f" above {above:g}" if is_above else f" of at least {least:g}" if has_least else ""
    upper = f" of at most {most:g}" if has_most else ""
    return lower + (" and" if lower and upper else "") + upper


COORDINATE = Number(-LARGEST_COORDINATE, LARGEST_COORDINATE)
"""One component of a position in the world."""
