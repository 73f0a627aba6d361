"""The pictures of a film that is not whole yet, kept beside it: one that was interrupted goes on where it stopped."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.data.errors import InputError, input_checked
from glassplat.files.atomic import atomic_write
from glassplat.files.folders import check_folder, make_folder
from glassplat.files.images import read_image
from glassplat.files.json_text import read_json

RECORD = "film.json"
OWN = re.compile(r"[0-9]{6}\.png|\.[0-9]{6}\.[0-9a-f]{12}\.tmp\.png")
"""A picture, or what is left of one that was being written when the program was killed."""
QUICK_COMPRESSION = 1


class KeptPictures:
    """A folder beside a film: `film.json`, which says what is filmed, and one PNG per picture, in order."""

    def __init__(self, film: Path) -> None:
        """Looks at nothing yet.

        Args:
            film: the film's file.
        """
        self.folder = film.with_name(f"{film.name}.pictures")

    @property
    def is_there(self) -> bool:
        """Whether a film was interrupted here."""
        return (self.folder / RECORD).is_file()

    @property
    def count(self) -> int:
        """How many pictures are there, from the first one on without a gap."""
        count = 0
        while self._path(count).is_file():
            count += 1
        return count

    def begin(self, described: Mapping[str, object]) -> None:
        """Makes the folder, without pictures, and records what is filmed.

        Args:
            described: by the names of options, what the pictures depend on; JSON's types.

        Raises:
            InputError: the folder holds something else.
            OSError: it cannot be written.
        """
        check_folder(self.folder)
        if self.folder.exists() and any(self.folder.iterdir()) and not self.is_there:
            raise InputError(
                f"{self.folder} is not empty, and not from an interrupted film; nothing was written. Choose another "
                "--output"
            )
        self.remove()
        make_folder(self.folder)
        with atomic_write(self.folder / RECORD) as temporary:
            temporary.write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")

    def check_same(self, described: Mapping[str, object]) -> None:
        """Refuses to go on with another film.

        Args:
            described: as for `begin`.

        Raises:
            InputError: something else was filmed; names what differs.
        """
        with input_checked():
            recorded = read_json(self.folder / RECORD)
        if not isinstance(recorded, dict):
            raise InputError(f"{self.folder / RECORD} is damaged; delete {self.folder}, and repeat without --resume")
        wanted = json.loads(json.dumps(described))
        differing = [name for name in {**wanted, **recorded} if wanted.get(name) != recorded.get(name)]
        if differing:
            raise InputError(
                f"{', '.join(differing)} {'is' if len(differing) == 1 else 'are'} no longer as when the film was "
                f"interrupted; repeat that command with --resume, or this one with --force to begin again"
            )

    def write(self, index: int, picture: NDArray[np.uint8]) -> None:
        """Keeps one picture [H, W, 3].

        Raises:
            OSError: the disk is full, or fails.
        """
        with atomic_write(self._path(index)) as temporary:
            Image.fromarray(picture).save(temporary, compress_level=QUICK_COMPRESSION)

    def pictures(self, count: int) -> Iterator[NDArray[np.uint8]]:
        """The first pictures [H, W, 3], read when they are asked for.

        Raises:
            InputError: one is missing or damaged.
        """
        for index in range(count):
            with input_checked():
                yield read_image(self._path(index))

    def remove(self) -> None:
        """Deletes what was kept, and nothing else."""
        if not self.is_there:
            return
        for path in self.folder.iterdir():
            if OWN.fullmatch(path.name):
                path.unlink()
        (self.folder / RECORD).unlink()
        with suppress(OSError):  # Somebody else's files stay, and their folder.
            self.folder.rmdir()

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:06d}.png"
