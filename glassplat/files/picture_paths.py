"""Which file of a folder holds the picture of which view, whatever the views are called."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import count, takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath

Parts = tuple[str, ...]


def picture_paths(names: Sequence[str]) -> dict[str, Path]:
    """The PNG of each view, relative to a folder that it never leads out of: the photograph's name, as far as it goes.

    Folders inside of the capture stay (`left/1.jpg` is `left/1.png`). A name that is an absolute path or climbs with
    `..` keeps what sets it apart from the others of its kind (`/home/me/photos/left/1.jpg` is `left/1.png` too).
    No two pictures share a file, nor does one lie where another needs a folder, also where case makes no difference.

    Args:
        names: of all views of the capture, so that a picture's name does not depend on which of them are asked for.
    """
    return _distinct(_inside(names))


def flat_picture_names(names: Sequence[str]) -> dict[str, str]:
    """The same without folders, as names of files that lie side by side."""
    flat = {name: ("_".join(parts),) for name, parts in _inside(names).items()}
    return {name: path.name for name, path in _distinct(flat).items()}


def _distinct(parts: Mapping[str, Parts]) -> dict[str, Path]:
    """A file for every name; who has a plain name to himself gets it before others look for one."""
    plain = {name: _key(_plain(own)) for name, own in parts.items()}
    times = Counter(plain.values())
    taken: set[str] = set()
    paths: dict[str, Path] = {}
    # The deepest first, so that no file can stand where one of them needs a folder.
    for name in sorted(parts, key=lambda name: (-len(parts[name]), times[plain[name]] > 1)):
        wanted = _candidates(parts[name], clash=times[plain[name]] > 1)
        path = next(path for path in wanted if _is_free(path, taken))
        taken |= {_key(path), *(f"{_key(folder)}/" for folder in path.parents)}
        paths[name] = Path(path)
    return {name: paths[name] for name in parts}


def _inside(names: Sequence[str]) -> dict[str, Parts]:
    """Folders and file of each name, without what leads out; backslashes divide, as on Windows."""
    parts = {name: _normal(name) for name in names}
    outside = [name for name in names if _leads_out(name)]
    columns = zip(*(parts[name][:-1] for name in outside), strict=False)
    shared = sum(1 for _ in takewhile(lambda column: len(set(column)) == 1, columns))
    return parts | {name: parts[name][shared:] for name in outside}


def _leads_out(name: str) -> bool:
    path = PureWindowsPath(name)
    return bool(path.anchor) or ".." in path.parts


def _normal(name: str) -> Parts:
    path = PureWindowsPath(name)
    kept: list[str] = []
    for part in path.parts[bool(path.anchor) :]:
        if part == "..":
            kept[-1:] = []
        else:
            kept.append(part)
    return tuple(kept) or ("view",)


def _plain(parts: Parts) -> PurePosixPath:
    return PurePosixPath(*parts).with_suffix(".png")


def _candidates(parts: Parts, *, clash: bool) -> Iterator[PurePosixPath]:
    """Names in the order in which they are wanted; with the photograph's own suffix where the plain one would clash."""
    if not clash:
        yield _plain(parts)
    whole = PurePosixPath(*parts)
    yield whole.with_name(f"{whole.name}.png")
    yield from (whole.with_name(f"{whole.name}-{number}.png") for number in count(2))


def _is_free(path: PurePosixPath, taken: set[str]) -> bool:
    """Whether the path is neither a file yet nor a folder of one."""
    return not {_key(path), f"{_key(path)}/"} & taken


def _key(path: PurePosixPath) -> str:
    """What file systems that ignore case take a path for."""
    return unicodedata.normalize("NFC", str(path)).casefold()
