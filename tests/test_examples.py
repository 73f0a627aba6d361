"""The examples run as described, on the bundled scene, small and short."""

from __future__ import annotations

import contextlib
import io
import json
import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path

import pytest
import torch

import glassplat
from glassplat.captures.view import estimated_normals
from glassplat.cli import main
from tests.training.tiny_capture import write_tiny_capture

EXAMPLES = Path(__file__).parent.parent / "examples"
DEMO = Path(glassplat.__file__).parent / "demo_scene"


def said_by(example: str, *options: str, folder: Path) -> str:
    """Output of an example, run in a folder, in this process, which has already loaded its kernels."""
    path, said = EXAMPLES / example, io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.chdir(folder)
        patch.setattr(sys, "argv", [str(path), *options])
        patch.setattr("glassplat.training.actions.GRID_CELLS", 24)  # Takes up to half of a training.
        runpy.run_path(str(path), run_name="__main__")
    return said.getvalue()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the first example was run."""
    folder = tmp_path_factory.mktemp("place")
    said = said_by("1_train.py", "--iterations", "60", "--downscale", "12", folder=folder)
    assert "panes (1,)" in said and "stage" in said and re.search(r"PSNR \d\d\.\d\d dB .*\d dB over the panes", said)
    return folder


def test_the_examples_are_numbered_and_explained() -> None:
    assert [path.name[:2] for path in sorted(EXAMPLES.glob("*.py"))] == ["1_", "2_", "3_", "4_", "5_"]
    for path in EXAMPLES.glob("*.py"):
        assert f"\npython examples/{path.name} " in path.read_text()


def test_layers_are_written(place: Path) -> None:
    said = said_by("2_layers.py", "runs/place", "--frames", "2", folder=place)
    pictures = {path.stem for path in (place / "pictures").iterdir()}
    assert {"rgb", "transmission", "reflection", "orbit_000", "orbit_001"} <= pictures
    assert "'strength': (" in said


def test_panes_are_edited(place: Path) -> None:
    said = said_by("3_panes.py", "runs/place", folder=place)
    changes = [float(number) for number in re.findall(r"by (0\.\d+)", said)]
    assert len(changes) == 4 and min(changes) > 0
    assert "2 panes" in said and (place / "edited" / "page.html").is_file() and (place / "edited" / "run").is_dir()


def test_the_gradient_example_lowers_its_loss(place: Path) -> None:
    said = said_by("4_gradients.py", "runs/place", "--downscale", "12", "--steps", "21", folder=place)
    losses = [float(number) for number in re.findall(r"loss (0\.\d+)", said)]
    assert losses[-1] < losses[0]


def cells_of_the_notebook() -> list[str]:
    cells = json.loads((EXAMPLES / "colab.ipynb").read_text(encoding="utf-8"))["cells"]
    assert not any(cell.get("outputs") for cell in cells)
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_the_commands_of_the_notebook_exist() -> None:
    lines = [line for cell in cells_of_the_notebook() for line in cell.splitlines() if line.startswith("!glassplat")]
    calls = [shlex.split(line)[1:] for line in lines]
    assert [call[0] for call in calls] == ["--version", "demo", "export"]
    for call in calls[1:]:
        assert type(main.parse_arguments(call)).__name__.startswith(main.COMMANDS[call[0]].kind)


def test_the_notebook_shows_layers_of_its_run(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (place / "runs" / "demo").mkdir()
    shutil.copytree(place / "runs" / "place", place / "runs" / "demo" / "planar")
    monkeypatch.chdir(place)
    *statements, shown = next(cell for cell in cells_of_the_notebook() if "glassplat.load" in cell).splitlines()
    names = {"torch": torch}
    exec("\n".join(statements), names)
    height, width = names["pictures"][0].shape[:2]
    assert eval(shown, names).size == (4 * width, height)


HUB = """
import torch

dependencies = ["torch"]


class Slope(torch.nn.Module):
    def inference(self, data):
        height, width = data["input"].shape[2:]
        # Half as large, in axes with y down and z forward: faces the camera and, the lower half, up.
        normals = torch.zeros(1, 4, height // 2, width // 2)
        normals[:, 2] = -0.8
        normals[:, 1, height // 4 :] = -0.6
        normals[:, 0, : height // 4] = 0.6
        return None, None, {"prediction_normal": normals}


def slope(pretrain):
    assert pretrain
    return Slope()
"""


def test_an_unavailable_network_ends_with_one_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*place: str, **options: object) -> None:
        raise RuntimeError("It looks like there is no internet connection")

    monkeypatch.setattr(torch.hub, "load", fail)
    with pytest.raises(
        SystemExit, match=r"cannot load metric3d_vit_small of yvanyin/metric3d.*no internet(.|\n)*--repo"
    ):
        said_by("5_estimated_normals.py", "--data", str(DEMO), folder=tmp_path)


def test_estimated_normals_are_written_where_they_are_read(tmp_path: Path) -> None:
    capture, hub = write_tiny_capture(tmp_path / "capture"), tmp_path / "hub"
    for photograph in sorted((capture / "images").iterdir()):
        photograph.rename(photograph.with_suffix(".jpg"))
    cameras = capture / "transforms.json"
    cameras.write_text(cameras.read_text().replace(".png", ".jpg"))
    hub.mkdir()
    (hub / "hubconf.py").write_text(HUB)
    options = ["--repository", str(hub), "--model", "slope", "--height", "64", "--width", "128", "--device", "cpu"]
    said_by("5_estimated_normals.py", "--data", str(capture), *options, folder=tmp_path)
    views = glassplat.load_dataset(capture).train
    for view in (views[0], views[-1]):
        normals = estimated_normals(view)
        assert normals is not None
        in_camera = normals @ view.camera.cam_from_world[:3, :3].T
        height, width = in_camera.shape[:2]
        for row, expected in ((height // 4, [0.6, 0.0, -0.8]), (3 * height // 4, [0.0, -0.6, -0.8])):
            torch.testing.assert_close(in_camera[row, width // 2], torch.tensor(expected), atol=0.01, rtol=0)
