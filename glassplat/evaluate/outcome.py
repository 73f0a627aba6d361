"""What a metric comes to: a number, or the reason why there is none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

Outcome = float | str
"""A metric's value, or a sentence on why there is none."""

SMALLEST_REGION = 100
"""Pixels that a view's region needs to count; a sliver of a pane says nothing."""
NO_LPIPS = "no LPIPS"


def plain(outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
    """JSON values: numbers as they are; None, and `<name>_reason`, where there is no finite number."""
    result: dict[str, Any] = {}
    for name, outcome in outcomes.items():
        reason = outcome if isinstance(outcome, str) else "infinite: the images are equal"
        is_number = not isinstance(outcome, str) and math.isfinite(outcome)
        result |= {name: outcome} if is_number else {name: None, f"{name}_reason": reason}
    return result
