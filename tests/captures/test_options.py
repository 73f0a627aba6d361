"""Options satisfy their annotations, whether they come from the command line or from a file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from glassplat.errors import InputError
from glassplat.options import (
    Ascending,
    Coordinate,
    Count,
    OpenShare,
    PaneLabel,
    Positive,
    Range,
    Share,
    as_option,
    check_options,
    check_value,
    expectation,
    unwrap_annotation,
)
from tests.methods.number_fields import number_fields


@dataclass(frozen=True)
class Inner:
    rate: Positive = 1.0
    most: Count | None = None


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner = field(default_factory=Inner)
    whole: bool = True
    color: tuple[Share, Share, Share] | None = None
    moments: Annotated[tuple[Share, ...], Ascending()] = ()
    kind: Literal["a", "b"] = "a"
    by_label: dict[PaneLabel, Coordinate] = field(default_factory=dict)
    folder: Path = Path("x")
    end_value: OpenShare = 0.5

    def contradiction(self) -> str | None:
        return "--whole and --kind b do not fit" if self.whole and self.kind == "b" else None


GOOD = {
    "name": "n",
    "inner": {"rate": 2, "most": 5},
    "whole": False,
    "color": [0, 0.5, 1],
    "moments": [0.1, 0.1, 0.9],
    "kind": "b",
    "by_label": {},
    "folder": "y",
    "end_value": 0.25,
}


def test_json_values_become_options() -> None:
    made = check_value(Outer, GOOD)
    inner = Inner(2.0, 5)
    assert made == Outer("n", inner, False, (0, 0.5, 1), (0.1, 0.1, 0.9), "b", {}, Path("y"), 0.25)
    assert isinstance(made.inner.rate, float) and isinstance(made.color, tuple)
    assert check_value(Outer, {"name": "n"}) == Outer("n")
    check_options(made)


WRONG = [
    ({"inner": {"rate": 0}}, "--inner.rate", "a number > 0"),
    ({"inner": {"rate": math.nan}}, "--inner.rate", "nan"),
    ({"inner": {"rate": math.inf}}, "--inner.rate", "inf"),
    ({"inner": {"rate": -1e-30}}, "--inner.rate", "-1e-30"),
    ({"inner": {"most": -1}}, "--inner.most", "a whole number from 0 to 1000000000, or None"),
    ({"inner": {"most": 10**12}}, "--inner.most", "1000000000000"),
    ({"color": (0, 0, 1.5)}, "--color", "3 values, each a number from 0 to 1, or None"),
    ({"moments": (0.5, 0.4)}, "--moments", "in ascending order"),
    ({"moments": (0.5, math.nan)}, "--moments", "any number of values, each a number from 0 to 1"),
    ({"by_label": {0: 1.0}}, "--by-label", "from 1 to 255"),
    ({"by_label": {1: math.inf}}, "--by-label", "inf"),
    ({"end_value": 1.0}, "--end-value", "a number > 0 and < 1"),
    ({"kind": "b"}, "--whole and --kind b", "do not fit"),
]


def made_of(fields: dict[str, Any]) -> Outer:
    inner = Inner(**fields["inner"]) if "inner" in fields else Inner()
    return Outer(**{"name": "n", **fields, "inner": inner})


@pytest.mark.parametrize(("fields", "option", "expected"), WRONG, ids=str)
def test_an_option_out_of_range_is_named_as_it_is_typed(fields: dict[str, Any], option: str, expected: str) -> None:
    with pytest.raises(InputError) as raised:
        check_options(made_of(fields))
    assert option in str(raised.value) and expected in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(("fields", "option", "expected"), WRONG, ids=str)
def test_a_file_with_such_a_value_is_refused_too(fields: dict[str, Any], option: str, expected: str) -> None:
    with pytest.raises(InputError, match=r"expected|do not fit"):
        check_value(Outer, {"name": "n", **fields})


@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        "text",
        5,
        {},
        {**GOOD, "more": 1},
        {**GOOD, "name": 5},
        {**GOOD, "name": None},
        {**GOOD, "inner": 3},
        {**GOOD, "inner": None},
        {**GOOD, "inner": {"rate": "1"}},
        {**GOOD, "inner": {"rate": True}},
        {**GOOD, "inner": {"rate": None}},
        {**GOOD, "inner": {"rate": 10**400}},
        {**GOOD, "inner": {"most": 1.5}},
        {**GOOD, "inner": {"most": True}},
        {**GOOD, "inner": {"unknown": 1}},
        {**GOOD, "whole": 1},
        {**GOOD, "whole": "yes"},
        {**GOOD, "color": "red"},
        {**GOOD, "color": [0, 0]},
        {**GOOD, "color": {"r": 1}},
        {**GOOD, "color": [0, 0, "1"]},
        {**GOOD, "moments": 0.5},
        {**GOOD, "moments": [[0.5]]},
        {**GOOD, "kind": "c"},
        {**GOOD, "kind": True},
        {**GOOD, "kind": ["a"]},
        {**GOOD, "by_label": []},
        {**GOOD, "folder": 5},
    ],
    ids=lambda value: str(value)[:60],
)
def test_a_file_of_another_kind_is_refused(value: Any) -> None:
    with pytest.raises(InputError) as raised:
        check_value(Outer, value)
    assert len(str(raised.value)) < 400


def test_a_number_of_too_many_digits_to_print_is_refused() -> None:
    with pytest.raises(InputError, match="digits"):
        check_value(Inner, {"most": 10**5000})


def test_options_are_named_by_their_fields() -> None:
    assert as_option("plane_fit.mirror_labels") == "--plane-fit.mirror-labels"
    names = {name for name, _ in number_fields(Outer)}
    assert names == {"inner.rate", "inner.most", "color", "moments", "by_label", "end_value"}


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        (Annotated[int, Range(1)], "a whole number >= 1"),
        (Annotated[float, Range(high=2)], "a number <= 2"),
        (tuple[Share, Positive], "2 values, out of: a number from 0 to 1; a number > 0"),
        (Literal["x", "y"], "one of x, y"),
        (Inner, "an object with named values"),
    ],
    ids=str,
)
def test_expectations_are_readable(hint: Any, words: str) -> None:
    assert expectation(*unwrap_annotation(hint)) == words
