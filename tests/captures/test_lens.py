"""Lenses without pycolmap, compared with it, and the messages where it is missing."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest
from PIL import Image

from glassplat.captures import colmap_library
from glassplat.captures.cameras import MODEL_OF_ID, PARAMETER_COUNTS, PERSPECTIVE, Lens, blank_share, pinhole_of
from glassplat.captures.colmap import ModelImage, pose_matrix
from glassplat.captures.dataset import load_dataset
from glassplat.errors import InputError


@pytest.fixture
def without_pycolmap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.delitem(vars(colmap_library), "pycolmap", raising=False)  # Reading the attribute would import it.
    pinhole_of.cache_clear()


def example(model: str) -> Lens:
    counts = PARAMETER_COUNTS[model]
    parameters = [30.0, 31.0][: counts.focal] + [16.0, 13.0][: counts.principal_point] + [0.01] * counts.extra
    return Lens(model, tuple(parameters), 32, 24)


def test_the_table_of_models_is_colmaps() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    members = {name: int(found) for name, found in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert members == {name: number for number, name in MODEL_OF_ID.items()}
    for model, counts in PARAMETER_COUNTS.items():
        camera = pycolmap.Camera(model=model, width=32, height=24, params=[1.0] * counts.total)
        found = [camera.focal_length_idxs(), camera.principal_point_idxs(), camera.extra_params_idxs()]
        if model == "EQUIRECTANGULAR":  # Its parameters are its size and belong to no group.
            continue
        assert [len(list(indices)) for indices in found] == [counts.focal, counts.principal_point, counts.extra]


@pytest.mark.parametrize("model", [name for name, counts in PARAMETER_COUNTS.items() if counts.focal])
def test_a_lens_is_rescaled_as_colmap_does_it(model: str) -> None:
    pytest.importorskip("pycolmap")
    lens = example(model)
    camera = lens.as_colmap()
    camera.rescale(65, 50)
    assert lens.rescale(65, 50).parameters == pytest.approx(tuple(camera.params), rel=1e-12)


@pytest.mark.parametrize("quat", [(1.0, 0.0, 0.0, 0.0), (0.1, -0.7, 0.5, 0.5), (0.0, 0.6, 0.0, -0.8)])
def test_quaternions_follow_the_convention_of_colmap(quat: tuple[float, ...]) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    found = pose_matrix(ModelImage("0000.jpg", 1, quat, (1.0, 2.0, 3.0)))
    w, x, y, z = quat
    np.testing.assert_allclose(found[:3, :3], pycolmap.Rotation3d(np.array([x, y, z, w])).matrix(), atol=1e-12)
    assert found[:3, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize("binary", [True, False])
def test_a_capture_of_pinholes_needs_no_pycolmap(capture, binary: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    capture.lenses = [("SIMPLE_PINHOLE", [40.0, 15.5, 12.5]), ("OPENCV", [30.0, 31.0, 16.0, 12.0, 0, 0, 0, 0])]
    capture.write_colmap(binary=binary)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.delitem(vars(colmap_library), "pycolmap", raising=False)  # Reading the attribute would import it.
    dataset = load_dataset(capture.root)
    lenses = {(view.camera.fx, view.camera.fy) for view in (*dataset.train, *dataset.test)}
    assert lenses == {(40, 40), (30, 31)}


@pytest.mark.usefixtures("without_pycolmap")
@pytest.mark.parametrize("model", [name for name in PARAMETER_COUNTS if "PINHOLE" not in name])
def test_a_distorting_lens_names_the_extra_that_undistorts_it(model: str) -> None:
    assert model not in PERSPECTIVE or example(model).parameters[-1]
    with pytest.raises(InputError, match=r"pip install 'glassplat\[prepare\]'"):
        pinhole_of(example(model))


@pytest.mark.parametrize("downscale", [1, 2])
def test_pixels_outside_a_strong_barrel_lens_are_excluded(capture, downscale: int) -> None:
    capture.size = (160, 120)
    capture.lenses = [("SIMPLE_RADIAL", [75.0, 80.0, 60.0, -0.3]), ("SIMPLE_RADIAL", [160.0, 80.0, 60.0, -0.1])]
    capture.write_colmap()
    for name in capture.names:
        Image.new("RGB", capture.size, "white").save(capture.root / "images" / name)
    capture.write_mask("ignore/0002.png", np.pad(np.full((40, 60), 255, np.uint8), ((40, 40), (50, 50))))
    data = load_dataset(capture.root, downscale=downscale)
    masked, wide, ordinary = (view for view in data.train if view.name in ("0002.png", "0004.png", "0005.png"))
    assert ordinary.ignored is None and wide.ignored is not None and masked.ignored is not None
    for view in (wide, masked):
        assert view.ignored is not None and bool((view.photo[~view.ignored] == 255).all())
        black = (view.photo == 0).all(dim=-1)
        assert black.double().mean() > 0.04 and bool(view.ignored[black].all())
    assert 0.04 < wide.ignored.double().mean() < 0.07
    assert masked.ignored.double().mean() > wide.ignored.double().mean() + 0.01
    assert any(re.search(r"up to 5\.\d% of an undistorted photograph", text) for text in data.warnings)


def test_ordinary_lenses_see_all_of_their_undistorted_photographs() -> None:
    pytest.importorskip("pycolmap")
    for model, count in (("SIMPLE_RADIAL", 1), ("OPENCV", 4), ("OPENCV_FISHEYE", 4), ("FOV", 1)):
        for focal in (400.0, 640.0):
            kinds = PARAMETER_COUNTS[model].focal
            lens = Lens(model, (*[focal] * kinds, 320.0, 240.0, -0.05, *[0.0] * (count - 1)), 640, 480)
            assert blank_share(lens) == 0
