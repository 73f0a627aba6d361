"""A suggestion of the pane that the room of these tests has."""

from __future__ import annotations

import numpy as np

from glassplat.suggest.suggestion import Suggestion
from tests.init.pane_scene import FRONT


def suggestions() -> list[Suggestion]:
    corners = FRONT.at(np.array([-1.0, 1, 1, -1]), np.array([-1.0, -1, 1, 1]))
    return [Suggestion(np.asarray(corners, dtype=np.float64), FRONT.normal, places=7, matches=20, views=5)]
