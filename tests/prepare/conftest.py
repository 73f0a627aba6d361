"""Photographs of the bundled scene in the form in which users provide them: alone, without poses."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from glassplat.cli.train import SCENE
from glassplat.prepare.photographs import Note
from glassplat.training.messages import Working

CONNECTED = ("0000", "0001", "0003", "0004", "0006", "0007", "0009", "0010", "0012", "0013")
"""Photographs of the bundled scene that overlap sufficiently."""


def copy_photographs(folder: Path) -> Path:
    """Copies the connected photographs under names with spaces and letters beyond ASCII."""
    folder.mkdir(parents=True)
    for name in CONNECTED:
        shutil.copy(SCENE / "images" / f"{name}.jpg", folder / f"Bild ä {name}.jpg")
    return folder


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    return copy_photographs(tmp_path / "my photographs")


class Heard(list):
    """Records the messages of a preparation."""

    def __call__(self, message: Working | Note) -> None:
        self.append(message)

    def whats(self) -> set[str]:
        return {message.what for message in self if isinstance(message, Working)}


@pytest.fixture
def heard() -> Heard:
    return Heard()
