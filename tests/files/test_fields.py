"""Tables of what a record has to hold."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest

from glassplat.files.fields import (
    ByName,
    Choice,
    Field,
    Flag,
    Items,
    Nullable,
    Number,
    Optional,
    Text,
    Whole,
    checked,
    checked_instance,
    field_of,
)

NOT_NUMBERS = [None, True, "1", [1], {}, math.nan, math.inf, -math.inf, 10**400]
CASES: list[tuple[Field, list[Any], list[Any]]] = [
    (Number(), [0, -1.5, 1e300, 2**64], NOT_NUMBERS),
    (Number(0, 1), [0, 1, 0.5], [-1e-9, 1.1, *NOT_NUMBERS]),
    (Number(above=0, most=5), [1e-300, 5], [0, -1, 5.1, *NOT_NUMBERS]),
    (Whole(), [0, -(2**63), 2**63 - 1], [2**63, 1.0, *NOT_NUMBERS]),
    (Whole(1, 3), [1, 3], [0, 4, 2.0, *NOT_NUMBERS]),
    (Flag(), [True, False], [0, 1, "true", None]),
    (Text(), ["a"], ["", 1, None, ["a"]]),
    (Choice(("auto", 1)), ["auto", 1], ["", True, 1.0, None, [], {}]),
    (Items(Whole()), [[], [1, 2]], [None, "12", {"0": 1}, [1, None]]),
    (Items(Number(), 2), [[1, 2]], [[], [1], [1, 2, 3], [1, math.nan], 12]),
    (ByName(Whole()), [{}, {"a": 1}], [[], {"a": None}, "a"]),
    (Nullable(Whole(0)), [None, 1], [-1, "a"]),
]


@pytest.mark.parametrize(("kind", "good", "bad"), CASES)
def test_a_field_takes_what_it_says_and_nothing_else(kind: Field, good: list[Any], bad: list[Any]) -> None:
    for value in good:
        read = kind.read(value, "it")
        assert read == (tuple(value) if isinstance(value, list) else value)
    for value in bad:
        with pytest.raises(ValueError, match=r"it is .*; expected"):
            kind.read(value, "it")


def test_numbers_are_read_in_one_type() -> None:
    assert isinstance(Number().read(2, "it"), float) and isinstance(Whole().read(2, "it"), int)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (Number(), "a finite number"),
        (Number(0, 1), "a finite number from 0 to 1"),
        (Number(above=0), "a finite number above 0"),
        (Number(above=0, most=2), "a finite number above 0 and of at most 2"),
        (Number(most=2), "a finite number of at most 2"),
        (Whole(1), "a whole number of at least 1"),
        (Choice(("a", "b")), "one of 'a', 'b'"),
        (Items(Whole(0), 2), "a list of 2 values, each a whole number of at least 0"),
        (Nullable(Text()), "a text that is not empty, or null"),
    ],
)
def test_what_was_expected_reads_well(kind: Field, text: str) -> None:
    assert kind.expected == text


TABLE = {"size": Whole(1), "name": Optional(Text(), "nobody")}


def test_an_object_is_checked_by_its_table() -> None:
    assert checked({"size": 2, "more": []}, TABLE, "it") == {"size": 2, "name": "nobody"}
    for value, message in (
        ([], r"it is \[\]; expected an object with size, name"),
        ({}, "it has no size; expected a whole number of at least 1"),
        ({"size": 0}, "size of it is 0; expected a whole number of at least 1"),
        ({"size": 1, "name": None}, "name of it is None; expected a text"),
        ({"size": "9" * 1000}, r"size of it is '9{79}\.\.\.; expected"),
    ):
        with pytest.raises(ValueError, match=message):
            checked(value, TABLE, "it")


@dataclass(frozen=True)
class Inner:
    share: Annotated[float, Number(0, 1)] = 0.5


@dataclass(frozen=True)
class Outer:
    count: Annotated[int, Whole(1)]
    kind: Literal["a", "b"] = "a"
    inner: Inner = field(default_factory=Inner)
    background: tuple[float, float, float] | None = None
    parts: tuple[str, ...] = ()


def test_a_dataclass_is_its_own_table() -> None:
    assert checked_instance(Outer, {"count": 3}, "it") == Outer(3)
    given = {"count": 3, "kind": "b", "inner": {"share": 1}, "background": [0, 1, 2], "parts": ["x"]}
    assert checked_instance(Outer, given, "it") == Outer(3, "b", Inner(1.0), (0.0, 1.0, 2.0), ("x",))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (None, "it is None; expected an object with count"),
        ([], r"it is \[\]; expected an object"),
        ({}, "it has no count"),
        ({"count": 0}, "count of it is 0; expected a whole number of at least 1"),
        ({"count": 1, "kind": "c"}, "kind of it is 'c'; expected one of 'a', 'b'"),
        ({"count": 1, "inner": {"share": 2}}, "share of inner of it is 2; expected a finite number from 0 to 1"),
        ({"count": 1, "inner": 2}, "inner of it is 2; expected an object"),
        ({"count": 1, "background": "red"}, "background of it is 'red'; expected a list of 3 values"),
        ({"count": 1, "background": [1, 2]}, r"background of it is \[1, 2\]; expected a list of 3 values"),
        ({"count": 1, "speed": 3}, "it has 'speed'; expected no other keys than count, kind"),
    ],
)
def test_a_record_that_does_not_fit_the_dataclass_is_named(given: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        checked_instance(Outer, given, "it")


@pytest.mark.parametrize("hint", [object, int | str, dict[str, int]])
def test_an_annotation_that_no_file_holds_is_a_mistake_of_the_program(hint: Any) -> None:
    with pytest.raises(TypeError, match="no field for the annotation"):
        field_of(hint)
