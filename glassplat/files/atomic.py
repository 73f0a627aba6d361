"""Files that are either written completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path next to `path`; on success it replaces `path` in one step.

    The temporary file has the suffix of `path`, which may be a link to a file without it, so writers that pick a format
    by suffix work unchanged. When the body raises (a
    full disk, Ctrl-C), the temporary file is removed and an older file at `path` keeps its contents. Missing parent
    folders are created.

    Example:
        with atomic_write(run / "results.json") as temporary:
            temporary.write_text(json.dumps(results))

    Raises:
        OSError: the target cannot be written; the message names it. Keeps the subclass, such as PermissionError.
    """
    target = Path(os.path.realpath(path))
    # Shortened, because a name that is as long as names may be leaves no room for more.
    temporary = target.with_name(f".{target.stem[:32]}.{uuid4().hex[:12]}.tmp{Path(path).suffix[:32]}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush_to_disk(temporary)
        os.replace(temporary, target)
    except OSError as error:
        reason = error.strerror or str(error)
        message = f"could not write {path} ({reason}); whatever was there before is unchanged"
        raise (OSError(message) if error.errno is None else OSError(error.errno, message)) from error
    finally:
        with suppress(OSError):  # never hide the error above behind one from the clean-up
            temporary.unlink()


def _flush_to_disk(path: Path) -> None:
    """Force the contents out, so that a crash cannot leave the new name on an empty file."""
    descriptor = os.open(path, os.O_RDWR)  # Windows flushes only what may be written.
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
