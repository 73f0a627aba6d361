"""A file is written completely or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from glassplat.files.writing import atomic_write


def test_a_write_replaces_the_file_and_leaves_no_other(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folder" / "results.json"
    for content in ("first", "second"):
        with atomic_write(target) as temporary:
            assert temporary.suffix == ".json"
            temporary.write_text(content)
        assert target.read_text() == content
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize("error", [RuntimeError("interrupted"), KeyboardInterrupt()])
def test_a_failed_write_keeps_the_old_file(tmp_path: Path, error: BaseException) -> None:
    target = tmp_path / "scene.ply"
    target.write_text("old")
    with pytest.raises(type(error)), atomic_write(target) as temporary:
        temporary.write_text("half of the ne")
        raise error
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_full_disk_names_the_target_and_keeps_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "scene.ply"
    target.write_text("old")
    with pytest.raises(OSError, match=r"could not write .*scene\.ply .*No space left") as caught, atomic_write(target):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.errno == errno.ENOSPC
    assert target.read_text() == "old"


def test_folder_that_is_a_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    refused = pytest.raises(OSError, match=r"could not write .*a\.json \([A-Z][a-z ]*\)$")
    with refused, atomic_write(tmp_path / "file" / "a.json") as temporary:
        temporary.write_text("never reached")


def test_a_failed_first_write_speaks_of_no_previous_contents(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"scene\.ply \(No space left on device\)$"), atomic_write(tmp_path / "scene.ply"):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_follows_a_symbolic_link(tmp_path: Path) -> None:
    (tmp_path / "real.json").write_text("old")
    (tmp_path / "link.json").symlink_to(tmp_path / "real.json")
    with atomic_write(tmp_path / "link.json") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "real.json").read_text() == "new"


def test_names_of_maximum_length_are_accepted(tmp_path: Path) -> None:
    target = tmp_path / f"{'x' * 251}.png"
    with atomic_write(target) as temporary:
        temporary.write_text("content")
    assert target.read_text() == "content"


def test_writers_that_pick_a_format_see_the_suffix_of_a_link(tmp_path: Path) -> None:
    (tmp_path / "film.gif").symlink_to(tmp_path / "disk" / "film")
    with atomic_write(tmp_path / "film.gif") as temporary:
        assert temporary.suffix == ".gif"
        temporary.write_text("new")
    assert (tmp_path / "disk" / "film").read_text() == "new"


def test_an_oserror_without_errno_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    with (
        pytest.raises(OSError, match=r"^could not write .* \(a library said so\); the previous"),
        atomic_write(tmp_path / "a"),
    ):
        raise OSError("a library said so")
