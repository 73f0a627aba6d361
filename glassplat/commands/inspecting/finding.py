"""What `glassplat info` found out about a path."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

FEW_VIEWS = 20
"""Photographs, below which more are advised."""


@dataclass
class Finding:
    """What something is, how it is, and what can be done with it.

    Attributes:
        kind: what it is, in a few words.
        facts: by name, in the order in which they are told.
        problems: what keeps it from being used, or makes it worse, full sentences.
        next: commands that go on from here, each with what it does.
    """

    kind: str
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    next: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "kind": self.kind,
            "healthy": not self.problems,
            "facts": self.facts,
            "problems": self.problems,
            "next": self.next,
        }
