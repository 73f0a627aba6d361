"""Suggestions become marks that make the same pane again; those that are panes already are not made again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from glassplat.annotate.document import parsed_document
from glassplat.annotate.session import Session, opened_session
from tests.annotate.conftest import marked_document, saved, true_corners
from tests.annotate.suggested import suggestions
from tests.init.pane_scene import FRONT


@pytest.fixture
def session(room: Path) -> Session:
    return opened_session(room, lambda dataset: suggestions())


def test_marks_of_a_suggestion_make_its_pane(session: Session) -> None:
    (proposal,) = session.described()["suggestions"]
    pane = marked_document()["panes"][0] | {"corners": proposal["corners"]}
    (marked,) = parsed_document({"version": 1, "panes": [pane]}, "a test")
    fit = session.solve(marked).fit
    assert fit is not None
    assert abs(fit.shape.frame[2] @ FRONT.normal) > np.cos(np.radians(0.1))
    assert len(marked.views()) == 3
    assert fit.error < 0.1


def test_a_proposal_shows_where_it_is_in_every_view(session: Session) -> None:
    (proposal,) = session.described()["suggestions"]
    assert len(proposal["outlines"]) == len(session.views)
    for view, outline in enumerate(proposal["outlines"]):
        away = np.linalg.norm(np.array(outline)[:, None] - true_corners(view)[None], axis=2)
        assert away.min(axis=0).max() < 0.1


def test_what_is_marked_already_is_not_proposed(session: Session) -> None:
    saved(session, marked_document())
    assert session.described()["suggestions"] == []


def test_another_plane_is_still_proposed(room: Path) -> None:
    (one,) = suggestions()
    away = replace(one, corners=one.corners + 0.5 * FRONT.normal)
    session = opened_session(room, lambda dataset: [away])
    saved(session, marked_document())
    assert len(session.described()["suggestions"]) == 1
