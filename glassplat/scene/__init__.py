"""Plain data: Gaussians, cameras, planes and the scene that holds them. Nothing here renders."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

SH_ZERO = 0.28209479177387814
"""Value of the constant spherical harmonic: a colour is 0.5 more than its raw coefficient times this."""


def logit(share: float) -> float:
    """The logit of `share`, which is strictly between 0 and 1."""
    return math.log(share / (1 - share))


def check_tensor_names(tensors: Mapping[str, Any], known: Iterable[str], owner: str) -> dict[str, Any]:
    """The tensors by name, checked against those of `owner`.

    Raises:
        ValueError: a name is not in `known`.
    """
    unknown = set(tensors) - set(known)
    if unknown:
        raise ValueError(f"unknown tensors {sorted(unknown)}; {owner} have {sorted(known)}")
    return dict(tensors)
