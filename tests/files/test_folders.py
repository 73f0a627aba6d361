"""Output folders."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from glassplat.files.images import files_below
from glassplat.files.writing import SPLAT_WRITERS, check_folder, make_folder, scene_source


@pytest.mark.parametrize("name", ["new", "new/below/it", "there", "link"])
def test_a_folder_is_created_if_possible(name: str, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there")
    check_folder(tmp_path / name)
    assert not (tmp_path / "new").exists()
    make_folder(tmp_path / name)
    assert (tmp_path / name).is_dir()


@pytest.mark.parametrize("name", ["file", "file/below", "file/a/b", "nowhere", "nowhere/below", "loop", "x" * 300])
def test_obstructing_files_are_named_once(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(NotADirectoryError, match="folder") as caught:
        make_folder(tmp_path / name)
    assert str(caught.value).count(str(tmp_path)) <= 2 and "Errno" not in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "loop", "nowhere"]


def test_a_too_long_name_leaves_no_parent_folder(tmp_path: Path) -> None:
    with pytest.raises(NotADirectoryError, match="too long"):
        make_folder(tmp_path / "new" / ("x" * 300))
    assert not (tmp_path / "new").exists()


def test_a_folder_that_may_not_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(PermissionError, match="no permission to write"):
        make_folder(tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("kind", [*SPLAT_WRITERS, "new"])
def test_a_folder_that_export_wrote_holds_a_scene_whatever_its_format(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SPLAT_WRITERS, "new", "somewhere:write")
    (tmp_path / f"scene.{kind}").touch()
    assert scene_source(tmp_path) == tmp_path / f"scene.{kind}"


def test_files_are_found_in_folders_that_are_links_and_no_circle_is_endless(tmp_path: Path) -> None:
    for name in ("outside/1.png", "folder/a/2.png", "folder/3.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    folder = tmp_path / "folder"
    for name, target in (("b", "outside"), ("c", "folder/a"), ("a/up", "folder"), ("a/self", "folder/a")):
        (folder / name).symlink_to(tmp_path / target)
    (tmp_path / "outside" / "back").symlink_to(folder)
    (folder / "4.png").symlink_to("/nowhere")
    found = [path.relative_to(folder).as_posix() for path in files_below(folder)]
    assert sorted(found) == ["3.png", "4.png", "a/2.png", "b/1.png", "c/2.png"]
