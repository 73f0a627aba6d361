"""What stands before a pane, outlined roughly by hand, is found by GrabCut (Rother et al. 2004), from OpenCV."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glassplat.annotate.outline import filled
from glassplat.data.errors import InputError

Array = NDArray[np.float64]

LONGEST = 480
"""Pixels of the part of the photograph that is looked at: more takes seconds."""
MARGIN = 0.25
"""Of the outline's size: how much beside it is looked at, to learn what the background is like."""
ROUNDS = 5
SMALLEST = 0.01
"""Of the outline's area: smaller pieces are specks."""


def grabbed(photo: NDArray[np.uint8], outline: Array) -> list[Array]:
    """Outlines of the thing within a rough one.

    Args:
        photo: [H, W, 3].
        outline: [P, 2] pixels round the thing, with a little of what is beside it.

    Returns:
        [Q, 2] pixels of each piece; the rough outline itself where nothing in it differs from what is around it.

    Raises:
        InputError: OpenCV is missing, or the outline holds nothing of the photograph.
    """
    cv2 = _opencv()
    low, high = _window(outline, photo.shape[1], photo.shape[0])
    part = photo[low[1] : high[1], low[0] : high[0]]
    scale = min(1.0, LONGEST / max(part.shape[:2]))
    small = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    factor = np.array([small.shape[1], small.shape[0]]) / (high - low)
    inside = filled((outline - low) * factor, (small.shape[1], small.shape[0]))
    if not inside.any():
        raise InputError("the outline holds nothing of the photograph; draw it round what stands before the pane")
    if inside.all():
        return [outline]
    found = _foreground(cv2, np.ascontiguousarray(small[:, :, ::-1]), inside)
    return [piece / factor + low for piece in _pieces(cv2, found, SMALLEST * inside.sum())] or [outline]


def _window(outline: Array, width: int, height: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """[2] the first pixel and the one after the last, of the part around an outline."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    room = MARGIN * (high - low) + 4
    size = np.array([width, height])
    first = np.clip(np.floor(low - room), 0, size - 2).astype(np.int64)
    return first, np.clip(np.ceil(high + room), first + 2, size).astype(np.int64)


def _foreground(cv2: Any, colors: NDArray[np.uint8], inside: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """[H, W] 1 where a pixel within the outline is unlike those beside it."""
    cv2.setRNGSeed(0)  # The same outline gives the same answer.
    mask = np.where(inside, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(colors, mask, None, *models, ROUNDS, cv2.GC_INIT_WITH_MASK)
    return np.asarray(((mask == cv2.GC_PR_FGD) | (mask == cv2.GC_FGD)).astype(np.uint8))


def _pieces(cv2: Any, found: NDArray[np.uint8], least: float) -> list[Array]:
    """The outlines of what was found, along the pixels' outer edges, without specks."""
    doubled = np.kron(found, np.ones((2, 2), dtype=np.uint8))
    outlines, _ = cv2.findContours(doubled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    smooth = [cv2.approxPolyDP(outline, 1.0, True).reshape(-1, 2) for outline in outlines]
    return [one / 2 + 0.25 for one in smooth if len(one) > 2 and cv2.contourArea(one) / 4 >= least]


def _opencv() -> Any:
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        raise InputError("grab needs OpenCV, which is not installed; run pip install 'glassplat[video]'") from error
