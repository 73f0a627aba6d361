"""Files in the way of a preparation are named and stay unchanged."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
from PIL import Image

from glassplat.cli.main import main
from glassplat.errors import InputError
from glassplat.prepare import preparation, report_page
from glassplat.prepare.preparation import PAGE, RECORD, Report, WorkFolder


def refused(source: Path, output: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["prepare", str(source), "--output", str(output)]) == 2
    return " ".join(capsys.readouterr().err.split())


def test_a_folder_with_other_contents_is_kept(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "diary.txt").write_text("dear diary")
    assert "not from `glassplat prepare` (it holds diary.txt)" in refused(photographs, tmp_path / "mine", capsys)
    assert main(["prepare", str(photographs), "--output", str(tmp_path / "mine"), "--force"]) == 2
    assert (tmp_path / "mine" / "diary.txt").read_text() == "dear diary"


def test_foreign_files_in_the_work_folder_are_kept(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "capture.partial").mkdir()
    (tmp_path / "capture.partial" / "diary.txt").write_text("dear diary")
    assert main(["prepare", str(photographs), "--output", str(tmp_path / "capture"), "--force"]) == 2
    assert "capture.partial is in the way" in " ".join(capsys.readouterr().err.split())
    assert (tmp_path / "capture.partial" / "diary.txt").read_text() == "dear diary"


def test_the_output_may_not_lie_among_the_photographs(photographs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for output in (photographs, photographs / "capture"):
        assert "is inside the photographs' folder" in refused(photographs, output, capsys)
    assert len(list(photographs.iterdir())) == 10


def test_a_file_that_is_not_a_video_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("")
    assert "expected a folder of photographs, or a video" in refused(tmp_path / "notes.txt", tmp_path / "c", capsys)
    assert "no folder or video" in refused(tmp_path / "nowhere", tmp_path / "c", capsys)


def test_unusable_photographs_leave_no_files(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (photographs / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 cut off")
    assert "broken.jpg as an image" in refused(photographs, tmp_path / "capture", capsys)
    assert sorted(path.name for path in tmp_path.iterdir()) == [photographs.name]


def test_too_little_texture_is_reported_with_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    (tmp_path / "in").mkdir()
    for shade in range(100, 105):
        Image.new("RGB", (320, 240), (shade, shade, shade)).save(tmp_path / "in" / f"{shade}.png")
    message = refused(tmp_path / "in", tmp_path / "capture", capsys)
    assert "5 of 5 photographs have fewer than 50 features" in message
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_photographs_that_cannot_be_used_leave_no_folder(tmp_path: Path) -> None:
    (tmp_path / "photographs").mkdir()
    Image.new("RGB", (40, 28)).save(tmp_path / "photographs" / "a.png")
    output = tmp_path / "new" / "below" / "capture"
    assert main(["prepare", str(tmp_path / "photographs"), "--output", str(output)]) == 2
    assert not (tmp_path / "new").exists()


def test_a_link_to_itself_is_refused_as_output(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert "expected an existing or new folder" in refused(photographs, tmp_path / "loop", capsys)


def test_force_replaces_masks_that_were_prepared_and_no_others(tmp_path: Path) -> None:
    output, mask = tmp_path / "capture", tmp_path / "capture" / "ignore" / "left" / "1.png"
    mask.parent.mkdir(parents=True)
    mask.write_bytes(b"what a wide lens did not see")
    (output / RECORD).write_text(json.dumps({"masks": [hashlib.sha256(mask.read_bytes()).hexdigest()]}))
    WorkFolder(output).begin({}, resume=False, force=True)
    mask.write_bytes(b"a passer-by, too")
    with pytest.raises(InputError, match=r"capture holds ignore/left/1.png, which are not from `glassplat prepare`"):
        WorkFolder(output).begin({}, resume=False, force=True)


@pytest.mark.parametrize("name", ["normals/a.png", "notes.txt", "panes/a.png", "images/a_mask.jpg", "images/b/c.png"])
def test_force_removes_only_what_was_prepared(tmp_path: Path, name: str) -> None:
    output = tmp_path / "capture"
    hidden = (".DS_Store", "images/.DS_Store")  # macOS creates them when the folder is viewed.
    pictures = ("images/a.jpg", "images/b/c.jpg", "images/wall_mask.jpg")
    for made in (*pictures, *hidden, "sparse/0/cameras.bin", RECORD, PAGE, name):
        (output / made).parent.mkdir(parents=True, exist_ok=True)
        (output / made).write_text("{}")
    named = name if name.startswith("images/") else name.partition("/")[0]
    with pytest.raises(
        InputError,
        match=rf"capture holds {named}, which are not from `glassplat prepare` and would be removed by --force",
    ):
        WorkFolder(output).begin({}, resume=False, force=True)
    (output / name).unlink()
    if named != name:
        (output / named).rmdir()
    WorkFolder(output).begin({}, resume=False, force=True)


@pytest.mark.parametrize("record", ["[]", "{", '{"masks": 5}'])
def test_force_keeps_a_capture_whose_record_is_damaged(record: str, tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / RECORD).write_text(record)
    with pytest.raises(InputError, match=r"prepare\.json"):
        WorkFolder(tmp_path / "capture").begin({}, resume=False, force=True)


def test_a_mount_point_is_refused_as_output(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "disk").mkdir()
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path) == tmp_path / "disk")
    assert "a disk is mounted at" in refused(photographs, tmp_path / "disk", capsys)
    assert not (tmp_path / "disk.partial").exists()


def finish(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes preparations write an empty capture at once."""
    monkeypatch.setattr(preparation, "best_solution", lambda *_, **__: None)
    monkeypatch.setattr(preparation, "make_report", lambda _: Report(3, 3, (), (3,), 9, 0.1, 3.0, 9, (), "", 1, ()))
    monkeypatch.setattr(preparation, "write_capture", lambda _, folder, *__: (folder / "images").mkdir(parents=True))


@pytest.mark.parametrize("output", ["link", "."])
def test_an_output_may_be_a_link_or_the_current_folder(
    output: str, photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    finish(monkeypatch)
    monkeypatch.setattr(report_page, "write_page", lambda capture, target: target.write_text(capture.name))
    folder = tmp_path / "disk" / "shop"
    folder.mkdir(parents=True)
    (folder.parent / "link").symlink_to(folder)
    monkeypatch.chdir(folder if output == "." else folder.parent)
    assert main(["prepare", str(photographs), "--output", output]) == 0
    monkeypatch.chdir(tmp_path)
    assert (folder.parent / "link").is_symlink()
    assert sorted(path.name for path in folder.iterdir()) == ["images", PAGE, RECORD]
    assert sorted(path.name for path in folder.parent.iterdir()) == ["link", "shop"]


@pytest.mark.parametrize("option", ["--force", "--resume"])
def test_a_second_preparation_of_the_same_output_is_refused(
    option: str,
    photographs: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "locks").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "locks"))
    workplace = WorkFolder(tmp_path / "capture")
    with workplace.lock():
        workplace.begin({}, resume=False, force=False)
        assert main(["prepare", str(photographs), "--output", str(tmp_path / "capture"), option]) == 2
        assert "another preparation is writing" in " ".join(capsys.readouterr().err.split())
        assert (workplace.folder / "settings.json").is_file()
        with WorkFolder(tmp_path / "other").lock():
            pass
        assert len(list((tmp_path / "locks").glob("*.lock"))) == 1
    with workplace.lock():
        pass
    assert not list((tmp_path / "locks").glob("*.lock"))
