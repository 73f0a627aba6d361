"""The folder beside a capture in which it is made, so that nothing that is not whole ever lies under its name."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from glassplat.errors import InputError, first_names
from glassplat.files.records import read_json
from glassplat.files.writing import atomic_write, check_folder, make_folder

RECORD = "prepare.json"
"""In the capture: that it was prepared here, and the report."""
HAND_MADE = ("panes", "masks", "ignore", "planes.json", "annotations.json")
"""In a capture: what somebody spent time on."""


@dataclass(frozen=True)
class Workplace:
    """The folder in which a capture is made.

    Attributes:
        output: where the capture will be.
    """

    output: Path

    @property
    def folder(self) -> Path:
        """Beside the output, so that the finished capture is moved in one step."""
        return self.output.with_name(f"{self.output.name}.partial")

    @property
    def capture(self) -> Path:
        """The capture while it is written."""
        return self.folder / "capture"

    def begin(self, settings: Mapping[str, Any], *, resume: bool, force: bool) -> None:
        """Makes the folder, or finds the one of an interrupted preparation.

        Args:
            settings: what the work depends on; an interrupted one goes on with the same only.
            resume: go on with what was interrupted.
            force: begin again, and replace a capture that was prepared before.

        Raises:
            InputError: the output is something else, or what lies there does not fit.
        """
        self._check_output(force)
        known = self._known_settings()
        if known is not None and force and not resume:
            shutil.rmtree(self.folder)
            known = None
        if known is not None and not resume:
            raise InputError(
                f"{self.folder} holds an interrupted preparation of {self.output}; go on from it with --resume, or "
                "begin again with --force"
            )
        if known is not None and known != json.loads(json.dumps(settings)):
            changed = sorted(key for key in {*known, *settings} if known.get(key) != settings.get(key))
            raise InputError(
                f"{self.folder} was begun with another {first_names(changed)}; give the same to --resume, or begin "
                "again with --force"
            )
        if known is None:
            make_folder(self.folder)
            with atomic_write(self.folder / "settings.json") as temporary:
                temporary.write_text(json.dumps(settings, indent=1), encoding="utf-8")

    def finish(self, record: Mapping[str, Any]) -> None:
        """Writes the record into the finished capture and moves it to the output."""
        with atomic_write(self.capture / RECORD) as temporary:
            temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        if self.output.exists():
            before = self.folder / "before"
            shutil.rmtree(before, ignore_errors=True)
            os.replace(self.output, before)
        os.replace(self.capture, self.output)
        self.discard()

    def discard(self) -> None:
        """Removes the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _check_output(self, force: bool) -> None:
        check_folder(self.output)
        check_folder(self.folder)
        found = sorted(path.name for path in self.output.iterdir()) if self.output.exists() else []
        if not found:
            return
        if RECORD not in found:
            raise InputError(
                f"{self.output} is not empty, and not from `glassplat prepare` (it holds {first_names(found)}); "
                "nothing was written. Choose a new folder for --output"
            )
        if not force:
            raise InputError(
                f"{self.output} holds a capture that was prepared before; choose a new folder for --output, or replace "
                "it with --force"
            )
        made = [name for name in HAND_MADE if name in found]
        if made:
            raise InputError(
                f"{self.output} holds {first_names(made)}, which somebody made and which would not fit new poses; move "
                "the folder away, or choose a new one for --output"
            )

    def _known_settings(self) -> dict[str, Any] | None:
        """Those of an interrupted preparation; None where there is none.

        Raises:
            InputError: the folder is something else.
        """
        if not self.folder.exists() or not any(self.folder.iterdir()):
            return None
        try:
            content = read_json(self.folder / "settings.json")
        except (OSError, ValueError):
            content = None
        if not isinstance(content, dict):
            raise InputError(
                f"{self.folder} is in the way, and not from `glassplat prepare`; move it, or choose another --output"
            )
        return content
