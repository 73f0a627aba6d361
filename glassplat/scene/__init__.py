"""Plain data: Gaussians, cameras, planes and the scene that holds them. Nothing here renders."""

from __future__ import annotations

import math

SH_ZERO = 0.28209479177387814
"""Value of the constant spherical harmonic: a colour is 0.5 more than its raw coefficient times this."""


def logit(share: float) -> float:
    """The raw parameter whose sigmoid is `share`, strictly between 0 and 1."""
    return math.log(share / (1 - share))
