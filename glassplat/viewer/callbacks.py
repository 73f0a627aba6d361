"""What viser calls when somebody uses a control."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import wraps
from typing import Any

logger = logging.getLogger(__name__)


def survived(callback: Callable[..., Any]) -> Callable[..., None]:
    """The callback, whose errors end with it: viser's threads print tracebacks, and a training would end with them."""

    @wraps(callback)
    def call(*given: Any) -> None:
        try:
            callback(*given)
        except Exception as error:  # noqa: BLE001 - Whatever a client did, the others and the server go on.
            logger.warning("a browser asked for something that failed: %s: %s", type(error).__name__, error)

    return call
