import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from glassplat.errors import InputError
from glassplat.evaluate.truth import load_truth


def write_view(folder: Path, stem: str, labels: np.ndarray) -> None:
    for kind in ("trans", "refl", "strength"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    height, width = labels.shape
    Image.fromarray(np.full((height, width, 3), 10, np.uint8)).save(folder / "trans" / f"{stem}.png")
    Image.fromarray(np.full((height, width, 3), 20, np.uint8)).save(folder / "refl" / f"{stem}.png")
    Image.fromarray(np.full((height, width), 13107, np.uint16)).save(folder / "strength" / f"{stem}.png")
    Image.fromarray(labels).save(folder / "strength" / f"{stem}_pane.png")


LABELS = np.array([[1, 1, 2, 2, 0, 0], [1, 1, 2, 0, 0, 0]], dtype=np.uint8)


def test_a_missing_folder_means_no_truth() -> None:
    assert load_truth(None) is None


def test_layers_are_read_with_their_full_depth(tmp_path: Path) -> None:
    write_view(tmp_path, "0008", LABELS)
    truth = load_truth(tmp_path)
    assert truth is not None
    assert truth.planes == ()
    view = truth.view("images/0008.jpg", 6, 2)
    assert view is not None
    assert view.transmission.shape == (2, 6, 3)
    assert (view.transmission.unique().tolist(), view.reflection.unique().tolist()) == ([10], [20])
    torch.testing.assert_close(view.strength, torch.full((2, 6), 0.2))
    assert view.labels.tolist() == LABELS.tolist()


def test_photographs_of_one_name_in_two_folders_have_each_its_own_layers(tmp_path: Path) -> None:
    for folder, labels in (("left", LABELS), ("right", LABELS[:, ::-1])):
        for kind in ("trans", "refl", "strength"):
            (tmp_path / kind / folder).mkdir(parents=True)
        write_view(tmp_path, f"{folder}/0008", np.ascontiguousarray(labels))
    write_view(tmp_path, "0009", LABELS)
    truth = load_truth(tmp_path)
    assert truth is not None
    found = [truth.view(name, 6, 2) for name in ("left/0008.jpg", "right/0008.jpg", "right/0009.jpg")]
    assert [view.labels.tolist() for view in found if view] == [
        rows.tolist() for rows in (LABELS, LABELS[:, ::-1], LABELS)
    ]


def test_a_smaller_pixel_is_pane_only_where_the_pane_covers_it(tmp_path: Path) -> None:
    write_view(tmp_path, "0008", LABELS)
    truth = load_truth(tmp_path)
    assert truth is not None
    view = truth.view("0008.jpg", 3, 1)
    assert view is not None
    assert view.labels.tolist() == [[1, 0, 0]]
    torch.testing.assert_close(view.strength, torch.full((1, 3), 0.2))


def test_a_view_may_be_absent_but_not_incomplete(tmp_path: Path) -> None:
    write_view(tmp_path, "0008", LABELS)
    truth = load_truth(tmp_path)
    assert truth is not None
    assert truth.view("0016.jpg", 6, 2) is None
    (tmp_path / "refl" / "0008.png").unlink()
    with pytest.raises(ValueError, match=r"incomplete: .*refl.0008\.png missing"):
        truth.view("0008.jpg", 6, 2)


def test_a_broken_layer_is_named(tmp_path: Path) -> None:
    write_view(tmp_path, "0008", LABELS)
    (tmp_path / "refl" / "0008.png").write_bytes(b"no image")
    truth = load_truth(tmp_path)
    assert truth is not None
    with pytest.raises(InputError, match=r"cannot read .*refl.0008\.png as an image"):
        truth.view("0008.jpg", 6, 2)


def test_a_layer_of_other_proportions_is_refused(tmp_path: Path) -> None:
    write_view(tmp_path, "0008", np.ones((30, 40), np.uint8))
    truth = load_truth(tmp_path)
    assert truth is not None and truth.view("0008.jpg", 21, 16) is not None
    with pytest.raises(InputError, match=r"0008\.png is 40x30 pixels, its photograph 40x20 here.*expected the same"):
        truth.view("0008.jpg", 40, 20)


def test_a_layer_may_be_grey(tmp_path: Path) -> None:
    write_view(tmp_path, "0008", LABELS)
    Image.fromarray(np.full((2, 6), 30, np.uint8)).save(tmp_path / "refl" / "0008.png")
    truth = load_truth(tmp_path)
    assert truth is not None
    view = truth.view("0008.jpg", 6, 2)
    assert view is not None and view.reflection.tolist() == np.full((2, 6, 3), 30).tolist()


PLANE = {"label": 3, "center": [0, 1, 2], "normal": [0, 0, 1], "half_u": [1, 0, 0], "half_v": [0, 1, 0], "ior": 1.5}
PLANE |= {"mirror": True, "base_reflectance": 1.0}


def test_planes_are_read(tmp_path: Path) -> None:
    (tmp_path / "planes.json").write_text(json.dumps([PLANE]))
    truth = load_truth(tmp_path)
    assert truth is not None
    (plane,) = truth.planes
    assert (plane.label, plane.center, plane.mirror, plane.base_reflectance) == (3, (0.0, 1.0, 2.0), True, 1.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[{]", r"planes\.json is not valid JSON"),
        ("[" * 10**5, r"planes\.json is nested more than"),
        ("{}", r"planes\.json holds \{\}; expected a list with one object per plane"),
        ("[[1]]", r"plane 1 in .*planes\.json is \[1\]; expected an object with label, center"),
        (json.dumps([{"label": 1}]), "plane 1 in .* has no center; expected a list of 3 values"),
        (json.dumps([PLANE | {"label": 1e30}]), r"label of plane 1 in .* is 1e\+30; expected a whole number"),
        (json.dumps([PLANE | {"half_u": [0, 0, 10**400]}]), "entry 3 of half_u of plane 1 in .* is inf; expected"),
        (json.dumps([PLANE | {"normal": [0, 0, 0]}]), "normal of plane 1 in .* has length 0; expected a direction"),
    ],
)
def test_broken_planes_are_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "planes.json").write_text(content)
    with pytest.raises(InputError, match=message):
        load_truth(tmp_path)
