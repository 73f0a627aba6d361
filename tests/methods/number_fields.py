"""Numeric options, by the names with which they are typed."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

from glassplat.options import nested_name, unwrap_annotation


def number_fields(kind: type, name: str = "") -> Iterator[tuple[str, Any]]:
    """Every numeric option of a dataclass and of the dataclasses in it: its name and the annotation of each number."""
    for field, hint in typing.get_type_hints(kind, include_extras=True).items():
        if typing.get_origin(hint) is not typing.ClassVar:
            yield from _numbers(hint, nested_name(name, field, hint))


def _numbers(hint: Any, name: str) -> Iterator[tuple[str, Any]]:
    inner, _ = unwrap_annotation(hint)
    if inner in (int, float):
        yield name, hint
    elif isinstance(inner, type) and dataclasses.is_dataclass(inner):
        yield from number_fields(inner, name)
    elif typing.get_origin(inner) is not typing.Literal:
        for part in typing.get_args(inner):
            yield from _numbers(part, name)
