"""Images are written only to `--output`, and photographs stay unchanged, whatever their names."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from glassplat.cli.main import main
from glassplat.errors import InputError
from glassplat.files.writing import check_links
from tests.cli.colmap_run import write_colmap_capture, write_colmap_run
from tests.cli.tiny_run import write_run


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def awkward_names(kind: str, elsewhere: Path) -> list[str]:
    """Five names of photographs in or out of the capture."""
    return {
        "absolute": [f"{elsewhere}/{index}.png" for index in range(5)],
        "climbing": [f"../../elsewhere/{index}.png" for index in range(5)],
        "nested": [f"cam{index % 2}/{index}.png" for index in range(5)],
        "windows": [f"cam\\{index}.png" for index in range(5)],
        "alike": ["0.png", "0.bmp", "0.tif", "0.png.png", f"{elsewhere}/0.png"],
        "markup": [f"[bold]/[red]{index}[/red].png" for index in range(5)],
    }[kind]


@pytest.mark.parametrize("command", ["dereflect", "render", "eval"])
@pytest.mark.parametrize("kind", ["absolute", "climbing", "nested", "windows", "alike", "markup"])
def test_every_view_gets_a_picture_in_the_output_and_nothing_else_changes(
    kind: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_colmap_capture(tmp_path / "capture", awkward_names(kind, tmp_path / "elsewhere"))
    run = write_colmap_run(tmp_path / "run", tmp_path / "capture")
    output = run if command == "eval" else tmp_path / "output"
    before = {path: data for path, data in contents(tmp_path).items() if not path.startswith("run/")}
    options = [] if command == "eval" else ["--output", str(output), "--split", "all"]
    assert main([command, str(run), *options]) == 0
    after = contents(tmp_path)
    assert {path: data for path, data in after.items() if path.split("/")[0] not in ("run", "output")} == before
    pictures = list(output.rglob("sheets/*.png" if command == "eval" else "*.png"))
    assert len(pictures) == (1 if command == "eval" else 5)
    if kind == "nested" and command == "dereflect":
        assert (output / "cam0" / "0.png").is_file()
    assert "Traceback" not in capsys.readouterr().err


def test_a_picture_has_the_same_name_whichever_views_are_asked_for(tmp_path: Path) -> None:
    write_colmap_capture(tmp_path / "capture", awkward_names("alike", tmp_path / "elsewhere"))
    run = write_colmap_run(tmp_path / "run", tmp_path / "capture")
    for split in ("all", "test"):
        assert main(["dereflect", str(run), "--output", str(tmp_path / split), "--split", split]) == 0
    whole, part = contents(tmp_path / "all"), contents(tmp_path / "test")
    pictures = [name for name in part if name.endswith(".png")]
    assert pictures and all(part[name] == whole[name] for name in pictures)


@pytest.mark.parametrize("command", ["dereflect", "render"])
@pytest.mark.parametrize("link", ["file", "folder", "record"])
def test_links_out_of_the_output_are_refused(
    link: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, output = write_run(tmp_path / "run"), tmp_path / "output"
    options = [command, str(run), "--output", str(output), "--split", "all"]
    assert main(options) == 0
    images, below = tmp_path / "capture" / "images", output / "rgb" if command == "render" else output
    if link == "file":
        (below / "3.png").unlink()
        (below / "3.png").symlink_to(images / "3.png")
    elif link == "folder":
        shutil.rmtree(output)
        output.symlink_to(images)
    else:
        (images / "note.json").write_text((output / "glassplat.json").read_text())
        (output / "glassplat.json").unlink()
        (output / "glassplat.json").symlink_to(images / "note.json")
    before = contents(images)
    capsys.readouterr()
    assert main(options) == 2
    assert "nothing was written" in " ".join(capsys.readouterr().err.split())
    assert contents(images) == before


@pytest.mark.parametrize("name", ["results.json", "sheets", "sheets/0.png", "log.jsonl"])
def test_links_out_of_a_run_are_refused(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, mine = write_run(tmp_path / "run"), tmp_path / "mine" / "0.png"
    for path in (mine, run / "checkpoint.safetensors"):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"mine")
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).symlink_to(mine.parent if name == "sheets" else mine)
    again = ["train", "planar", "--data", str(tmp_path / "capture"), "--output", str(run), "--resume"]
    assert main(again if name == "log.jsonl" else ["eval", str(run)]) == 2
    assert "leads out of" in " ".join(capsys.readouterr().err.split())
    assert contents(mine.parent) == {"0.png": b"mine"}


def test_a_link_to_an_empty_folder_is_followed_and_no_folder_outside_is_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def searched(path: Path, pattern: str) -> Iterator[Path]:
        yield from () if path.samefile(tmp_path / "empty") else pytest.fail(f"{path} is searched for {pattern}")

    monkeypatch.setattr(Path, "rglob", searched)
    for name in ("run", "empty", "full/inner"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "run" / "point_cloud").symlink_to(tmp_path / "empty")
    (tmp_path / "run" / "sheets").symlink_to(tmp_path / "full")
    check_links(tmp_path / "run", ["point_cloud"])
    with pytest.raises(InputError, match="sheets is a link that leads out of"):
        check_links(tmp_path / "run", ["point_cloud", "sheets"])


def test_an_output_that_is_a_link_to_a_folder_is_that_folder(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    (tmp_path / "real").mkdir()
    (tmp_path / "output").symlink_to(tmp_path / "real")
    assert main(["dereflect", str(run), "--output", str(tmp_path / "output")]) == 0
    assert len(list((tmp_path / "real").glob("*.png"))) == 6


@pytest.mark.parametrize(
    ("command", "name"), [("dereflect", "file/below"), ("render", "nowhere"), ("train", "file"), ("demo", "nowhere")]
)
def test_an_impossible_output_folder_ends_with_one_message(
    command: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, capture = write_run(tmp_path / "run"), str(tmp_path / "capture")
    (tmp_path / "file").write_text("kept")
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    begins = {
        "dereflect": ["dereflect", str(run)],
        "render": ["render", str(run)],
        "train": ["train", "splat", "--data", capture],
        "demo": ["demo"],
    }
    before = contents(tmp_path)
    assert main([*begins[command], "--output", str(tmp_path / name)]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error:") and "folder" in message and "Errno" not in message
    assert contents(tmp_path) == before


@pytest.mark.parametrize("command", ["dereflect", "eval"])
def test_a_capture_that_has_moved_is_found_again(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, moved = write_run(tmp_path / "run"), tmp_path / "moved"
    shutil.move(tmp_path / "capture", moved)
    options = [command, str(run), *([] if command == "eval" else ["--output", str(tmp_path / "output")])]
    assert main(options) == 2
    assert "give its new location with --data" in " ".join(capsys.readouterr().err.split())
    assert main([*options, "--data", str(moved), "--device", "cpu"]) == 0


def test_evaluating_with_another_capture_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run")
    write_colmap_capture(tmp_path / "other", [f"other{index}.png" for index in range(5)])
    assert main(["eval", str(run), "--data", str(tmp_path / "other")]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "is not the capture that" in message and "0.png" in message and "other0.png" in message


@pytest.mark.parametrize("command", ["render", "eval"])
def test_a_capture_with_a_missing_photograph_is_refused(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every eighth one is for testing: without the first, photographs used for training would be tested."""
    run, poses = write_run(tmp_path / "run"), tmp_path / "capture" / "transforms.json"
    found = json.loads(poses.read_text())
    poses.write_text(json.dumps(found | {"frames": found["frames"][1:]}))
    options = [command, str(run), *([] if command == "eval" else ["--output", str(tmp_path / "output")])]
    assert main(options) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "is not the capture that" in message and "0.png only in the run" in message
    assert not (tmp_path / "output").exists()
