"""What somebody marked in a capture: one JSON document, the same in the browser and on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from glassplat.annotate.pane_fit import Marks, Shape
from glassplat.files.atomic import atomic_write
from glassplat.files.fields import ByName, Choice, Field, Items, Number, Optional, Whole, checked
from glassplat.files.json_text import read_json

Material = Literal["glass", "mirror", "screen"]

FILE = "annotations.json"
MOST_PANES, MOST_CORNERS, MOST_STROKES, MOST_PLACES = 64, 32, 500, 20_000
"""Of one document: more than anybody marks, and few enough to work with."""
FARTHEST = 1e6
PLACE = Items(Number(-FARTHEST, FARTHEST), 2)


@dataclass(frozen=True)
class Record:
    """A JSON object with known keys, as a field of another one."""

    fields: Mapping[str, Field]
    expected: str = "an object"

    def read(self, value: Any, where: str) -> dict[str, Any]:
        """The object's fields."""
        return checked(value, self.fields, where)


STROKE = Record(
    {
        "kind": Choice(("polygon", "brush")),
        "effect": Choice(("cut", "keep")),
        "radius": Optional(Number(0.1, 10_000), default=10.0),
        "points": Items(PLACE),
    }
)
PANE = Record(
    {
        "label": Whole(1, MOST_PANES),
        "material": Choice(("glass", "mirror", "screen")),
        "shape": Choice(("rectangle", "polygon")),
        "corners": Items(ByName(PLACE)),
        "edges": Optional(Items(ByName(Items(PLACE, 2))), default=()),
        "strokes": Optional(ByName(Items(STROKE)), default={}),
    }
)
DOCUMENT: dict[str, Field] = {
    "version": Choice((1,)),
    "panes": Items(PANE),
}


@dataclass(frozen=True)
class Stroke:
    """A part of one photograph that is, or is not, covered by what stands before the pane.

    Attributes:
        kind: a filled polygon, or a line as wide as a brush.
        effect: cut takes the part out of the mask, keep puts it back.
        radius: of the brush, in pixels of the photograph.
        points: [P, 2] pixels.
    """

    kind: Literal["polygon", "brush"]
    effect: Literal["cut", "keep"]
    radius: float
    points: Sequence[tuple[float, float]]


@dataclass(frozen=True)
class MarkedPane:
    """One pane as somebody marked it; views go by the names of their photographs."""

    label: int
    material: Material
    shape: Shape
    corners: Sequence[Mapping[str, tuple[float, float]]]
    edges: Sequence[Mapping[str, tuple[tuple[float, float], ...]]]
    strokes: Mapping[str, Sequence[Stroke]]

    def marks(self, numbers: Mapping[str, int]) -> Marks:
        """Its corners and edges by the numbers of views; those in photographs that are gone are left out."""
        corners = [_numbered(places, numbers) for places in self.corners]
        edges = [_numbered(places, numbers) for places in self.edges[: len(corners)]]
        return Marks(corners, edges)

    def views(self) -> set[str]:
        """Photographs with any mark of it."""
        marked = {name for places in (*self.corners, *self.edges) for name in places}
        return marked | {name for name, strokes in self.strokes.items() if strokes}


def _numbered(places: Mapping[str, Any], numbers: Mapping[str, int]) -> dict[int, Any]:
    return {numbers[name]: np.array(place, dtype=np.float64) for name, place in places.items() if name in numbers}


def parsed_document(value: Any, where: str) -> tuple[MarkedPane, ...]:
    """The panes of a document, checked.

    Raises:
        ValueError: it is no such document, or larger than anybody marks; names `where` it came from.
    """
    panes = tuple(_pane(entry) for entry in checked(value, DOCUMENT, where)["panes"])
    labels = [pane.label for pane in panes]
    if len(set(labels)) != len(labels):
        raise ValueError(f"{where} has the labels {labels}; expected every label once")
    for pane in panes:
        strokes = [stroke for several in pane.strokes.values() for stroke in several]
        if (
            len(pane.corners) > MOST_CORNERS
            or len(strokes) > MOST_STROKES
            or sum(len(stroke.points) for stroke in strokes) > MOST_PLACES
        ):
            raise ValueError(
                f"pane {pane.label} of {where} has {len(pane.corners)} corners and {len(strokes)} strokes; expected at "
                f"most {MOST_CORNERS} and {MOST_STROKES}, of {MOST_PLACES} points"
            )
    return panes


def _pane(entry: Mapping[str, Any]) -> MarkedPane:
    strokes = {name: tuple(Stroke(**stroke) for stroke in several) for name, several in entry["strokes"].items()}
    return MarkedPane(
        entry["label"], entry["material"], entry["shape"], entry["corners"], entry["edges"], strokes=strokes
    )


def read_document(folder: Path) -> Any:
    """The document of a capture as JSON; an empty one where nothing was marked yet.

    Raises:
        ValueError: the file is damaged.
    """
    path = folder / FILE
    if not path.exists():
        return {"version": 1, "panes": []}
    value = read_json(path)
    parsed_document(value, str(path))
    return value


def version_of(value: Any) -> str:
    """What tells a document from others: a digest of all that is in it."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:24]


def write_document(folder: Path, value: Any) -> None:
    """Writes a document that was checked."""
    with atomic_write(folder / FILE) as temporary:
        temporary.write_text(json.dumps(value, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
