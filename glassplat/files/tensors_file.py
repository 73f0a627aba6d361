"""Named tensors and a header in one safetensors file, no pickle."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from glassplat.files.records import parse_json, reading
from glassplat.files.writing import atomic_write

HEADER_KEY = "glassplat"
LONGEST_REASON = 200


class TensorsFile(NamedTuple):
    """An open file: its header, and what its tensors are read from."""

    header: dict[str, Any]
    file: Any

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {name: self.file.get_tensor(name) for name in self.file.keys()}  # noqa: SIM118


def write_tensors(path: Path | str, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Writes tensors and a header atomically.

    Raises:
        OSError: the disk is full or not writable; an older file at `path` stays as it was.
    """
    owned = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    with atomic_write(path) as temporary:
        temporary.touch()
        usual_mode = temporary.stat().st_mode  # The library's own is for the owner alone, whatever the umask.
        try:
            save_file(owned, temporary, metadata={HEADER_KEY: json.dumps(header)})
        except SafetensorError as error:  # What the system says reaches Python in this disguise.
            raise OSError(str(error)) from error
        temporary.chmod(usual_mode)


@contextmanager
def opened_tensors(path: Path, file_format: str, what: str) -> Iterator[TensorsFile]:
    """A file that `write_tensors` wrote, its header checked to be of a format.

    Args:
        path: the file.
        file_format: what the header says under `format`.
        what: what the file is, for messages, such as "an environment".

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file cannot be read, is truncated or foreign; also if that shows while it is open.
    """
    try:
        with reading(path), _unicode_name(path) as name, safe_open(name, framework="pt") as file:
            header = parse_json((file.metadata() or {}).get(HEADER_KEY, "{}"), f"the header of {path}")
            if not isinstance(header, dict) or header.get("format") != file_format:
                found = header.get("format") if isinstance(header, dict) else header
                raise ValueError(f"{path} has format {found!r}; expected {file_format!r}, as glassplat writes it")
            yield TensorsFile(header, file)
    except SafetensorError as error:
        reason = str(error)[:LONGEST_REASON]  # It may repeat all of the header.
        raise ValueError(f"{path} is truncated or not {what} ({reason}); expected a whole file") from error


@contextmanager
def _unicode_name(path: Path) -> Iterator[Path]:
    """A name that the library opens: of a path with bytes that are no text, which it refuses, a link to it."""
    if _is_unicode(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "link.safetensors"
        link.symlink_to(path.absolute())
        yield link


def _is_unicode(path: Path) -> bool:
    return not any("\ud800" <= letter <= "\udfff" for letter in str(path))
