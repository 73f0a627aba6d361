"""Between the shares that people set and the raw parameters that are learned."""

from __future__ import annotations

import math


def logit(share: float) -> float:
    """The raw parameter whose sigmoid is `share`, strictly between 0 and 1."""
    return math.log(share / (1 - share))
