"""Tables of the fields required in a record."""

from __future__ import annotations

import math
from typing import Any

import pytest

from glassplat.files.records import (
    Boolean,
    Choice,
    DictOf,
    Field,
    Integer,
    ListOf,
    Nullable,
    Number,
    Optional,
    Text,
    check_fields,
)

NOT_NUMBERS = [None, True, "1", [1], {}, math.nan, math.inf, -math.inf, 10**400]
CASES: list[tuple[Field, list[Any], list[Any]]] = [
    (Number(), [0, -1.5, 1e300, 2**64], NOT_NUMBERS),
    (Number(0, 1), [0, 1, 0.5], [-1e-9, 1.1, *NOT_NUMBERS]),
    (Number(above=0, most=5), [1e-300, 5], [0, -1, 5.1, *NOT_NUMBERS]),
    (Integer(), [0, -(2**63), 2**63 - 1], [2**63, 1.0, *NOT_NUMBERS]),
    (Integer(1, 3), [1, 3], [0, 4, 2.0, *NOT_NUMBERS]),
    (Boolean(), [True, False], [0, 1, "true", None]),
    (Text(), ["a"], ["", 1, None, ["a"]]),
    (Choice(("auto", 1)), ["auto", 1], ["", True, 1.0, None, [], {}]),
    (ListOf(Integer()), [[], [1, 2]], [None, "12", {"0": 1}, [1, None]]),
    (ListOf(Number(), 2), [[1, 2]], [[], [1], [1, 2, 3], [1, math.nan], 12]),
    (DictOf(Integer()), [{}, {"a": 1}], [[], {"a": None}, "a"]),
    (Nullable(Integer(0)), [None, 1], [-1, "a"]),
]


@pytest.mark.parametrize(("kind", "good", "bad"), CASES)
def test_a_field_accepts_only_values_of_its_type(kind: Field, good: list[Any], bad: list[Any]) -> None:
    for value in good:
        read = kind.read(value, "it")
        assert read == (tuple(value) if isinstance(value, list) else value)
    for value in bad:
        with pytest.raises(ValueError, match=r"it is .*; expected"):
            kind.read(value, "it")


def test_numbers_are_read_in_one_type() -> None:
    assert isinstance(Number().read(2, "it"), float) and isinstance(Integer().read(2, "it"), int)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (Number(), "a finite number"),
        (Number(0, 1), "a finite number from 0 to 1"),
        (Number(above=0), "a finite number above 0"),
        (Number(above=0, most=2), "a finite number above 0 and of at most 2"),
        (Number(most=2), "a finite number of at most 2"),
        (Integer(1), "a whole number of at least 1"),
        (Choice(("a", "b")), "one of 'a', 'b'"),
        (ListOf(Integer(0), 2), "a list of 2 values, each a whole number of at least 0"),
        (Nullable(Text()), "a text that is not empty, or null"),
    ],
)
def test_expectations_in_messages_are_readable(kind: Field, text: str) -> None:
    assert kind.expected == text


TABLE = {"size": Integer(1), "name": Optional(Text(), "nobody")}


def test_an_object_is_checked_by_its_table() -> None:
    assert check_fields({"size": 2, "more": []}, TABLE, "it") == {"size": 2, "name": "nobody"}
    for value, message in (
        ([], r"it is \[\]; expected an object with size, name"),
        ({}, "it has no size; expected a whole number of at least 1"),
        ({"size": 0}, "size of it is 0; expected a whole number of at least 1"),
        ({"size": 1, "name": None}, "name of it is None; expected a text"),
        ({"size": "9" * 1000}, r"size of it is '9{79}\.\.\.; expected"),
    ):
        with pytest.raises(ValueError, match=message):
            check_fields(value, TABLE, "it")
