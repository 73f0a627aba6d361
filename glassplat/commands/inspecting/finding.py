"""What `glassplat info` found out about a path."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from glassplat.files.splat_suffixes import SPLAT_SUFFIXES

KINDS = f"a capture, photographs, a video, a run, an exported scene, or a splat file ({', '.join(SPLAT_SUFFIXES)})"
"""What there is to be found."""
FEW_VIEWS = 20
"""Photographs, below which more are advised."""


@dataclass
class Finding:
    """What something is, how it is, and what can be done with it.

    What takes long to find out comes in parts: finders yield them, and each adds to those before.

    Attributes:
        kind: what it is, in a few words; the first part says it.
        facts: by name, in the order in which they are told.
        problems: what keeps it from being used, or makes it worse, full sentences.
        next: commands that go on from here, each with what it does.
    """

    kind: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    next: list[str] = field(default_factory=list)

    def add(self, part: Finding) -> None:
        """Takes what was found next."""
        self.kind = self.kind or part.kind
        self.facts |= part.facts
        self.problems += part.problems
        self.next += part.next

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "kind": self.kind,
            "healthy": not self.problems,
            "facts": self.facts,
            "problems": self.problems,
            "next": self.next,
        }


Finder = Callable[[Path], Iterator[Finding]]
"""Finds out what a path holds, part by part."""
