"""JSON from files that anybody may have written; every reader of JSON in the package comes through here.

Nothing that is read is deeper than `DEEPEST`, no text in it is unprintable in UTF-8, no whole number has more than
`MOST_DIGITS` digits (a longer one becomes a float, which may be infinite), and no key of an object comes twice. What
the values have to be says `glassplat.files.fields`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from glassplat.files.reading import read_text

DEEPEST = 32
MOST_DIGITS = 20
"""Enough for every number of 64 bits."""


def read_json(path: Path) -> Any:
    """The contents of a JSON file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read or is no valid JSON; the message names the file.
    """
    return parse_json(read_text(path), str(path))


def parse_json(text: str, where: str) -> Any:
    """The value that a text in JSON stands for; `where` names the text in messages.

    Raises:
        ValueError: no valid JSON, nested too deeply, or with a key twice in one object.
    """
    try:
        value = json.loads(text, parse_int=_whole, object_pairs_hook=_without_repeats)
    except RecursionError as error:
        raise ValueError(_too_deep(where)) from error
    except ValueError as error:
        raise ValueError(f"{where} is not valid JSON ({error}); it is damaged or cut off: write it again") from error
    _check_nesting_and_text(value, where)
    return value


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) <= MOST_DIGITS else float(digits)


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {repeated!r} occurs twice in one object")
    return found


def _check_nesting_and_text(value: Any, where: str) -> None:
    """Level by level, without recursion of its own."""
    level = [value]
    for _ in range(DEEPEST):
        unprintable = next((text for text in level if isinstance(text, str) and not _is_encodable(text)), None)
        if unprintable is not None:
            raise ValueError(f"{where} holds the text {unprintable!r}, which is no valid Unicode; write it again")
        level = [inner for outer in level for inner in _inside(outer)]
        if not level:
            return
    raise ValueError(_too_deep(where))


def _inside(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [*value.keys(), *value.values()]
    return value if isinstance(value, list) else []


def _is_encodable(text: str) -> bool:
    """Half of a surrogate pair can be written in JSON, but in no file name and on no screen."""
    return text.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in text)


def _too_deep(where: str) -> str:
    return f"{where} is nested more than {DEEPEST} levels deep; expected a file that such a program wrote"
