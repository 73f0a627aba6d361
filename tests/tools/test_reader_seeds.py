"""The seeds for damaged files are readable files, and damage leads to a message."""

from __future__ import annotations

import random
import shutil
from contextlib import suppress
from pathlib import Path

import pytest

from tools.reader_seeds import READERS

WITHOUT_THE_REST = ("scene", "transforms")
"""Their seeds refer to files that do not exist."""


@pytest.mark.parametrize("name", READERS)
def test_seeds_are_read_and_damage_gets_a_message(name: str, tmp_path: Path) -> None:
    reader, seeds, place = READERS[name], tmp_path / "seeds", tmp_path / "place"
    seeds.mkdir()
    place.mkdir()
    reader.seeds(seeds)
    files = sorted(seeds.iterdir())
    assert files
    draw = random.Random(name)
    for file in files:
        shutil.copy(file, place / reader.name)
        if name not in WITHOUT_THE_REST:
            reader.read(place / reader.name)
        for _ in range(20):
            data = bytearray(file.read_bytes())
            for _ in range(draw.randint(1, 6)):
                data[draw.randrange(len(data))] = draw.randrange(256)
            (place / reader.name).write_bytes(data[: draw.randint(1, len(data))])
            with suppress(ValueError, FileNotFoundError):
                reader.read(place / reader.name)
