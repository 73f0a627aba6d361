"""Marks become masks and planes that the rest of the package reads."""

from __future__ import annotations

import json
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from glassplat.annotate.document import apply_strokes, fill_polygon, parse_document, project_outline
from glassplat.annotate.fit import fit_pane
from glassplat.annotate.results import pane_labels, resample_to_photograph
from glassplat.annotate.session import open_session
from glassplat.captures.dataset import load_dataset
from glassplat.captures.view import PhotoFile
from glassplat.cli.main import main
from glassplat.errors import InputError
from glassplat.files.images import read_image
from glassplat.panes.fit import fit_planes
from glassplat.scene.camera import NumpyCamera
from tests.annotate.conftest import NAMES, PLACES, marked_document, renamed, saved, write_colmap_room
from tests.panes.pane_scene import FRONT, Pane, camera_from, label_image, normal_error, offset_error

EVERYTHING = {"kind": "polygon", "effect": "cut", "radius": 1, "points": [[0, 0], [300, 0], [300, 220], [0, 220]]}


def finish(root: Path, document: dict) -> dict:
    session = open_session(root)
    saved(session, document)
    return session.finish()


def photographed_pane(root: Path, name: str) -> np.ndarray:
    return np.asarray(read_image(root / "images" / name)[:, :, 0] == 150)


def test_masks_show_the_pane_to_the_pixel(room: Path) -> None:
    finish(room, marked_document())
    for name in NAMES[:3]:
        mask = read_image(room / "panes" / name)[:, :, 0] == 1
        assert (mask != photographed_pane(room, name)).mean() < 0.001
    assert not (room / "panes" / NAMES[3]).exists()


def test_planes_and_masks_agree_with_each_other_and_the_truth(room: Path) -> None:
    finish(room, marked_document())
    dataset = load_dataset(room)
    assert dataset.planes is not None
    assert abs(normal_error(dataset.planes, 0, FRONT)) < 0.1 and offset_error(dataset.planes, 0, FRONT) < 1e-3
    np.testing.assert_allclose(sorted(dataset.planes.half_sizes[0].tolist()), [0.5, 0.8], atol=1e-3)
    annotations = [(view.camera, view.pane_labels) for view in dataset.train if view.pane_labels is not None]
    fitted = fit_planes(dataset.points.positions, annotations, extent=dataset.extent)
    assert abs(float(fitted.normals[0] @ dataset.planes.normals[0])) > 0.999


@pytest.mark.parametrize("material", ["glass", "mirror", "screen"])
def test_the_material_is_kept(material: str, room: Path) -> None:
    finish(room, marked_document(material=material))
    planes = load_dataset(room).planes
    assert planes is not None and planes.mirrors == ((1,) if material == "mirror" else ())


def test_occluders_are_cut_out(room: Path) -> None:
    left = [[0, 0], [150, 0], [150, 220], [0, 220]]
    stroke = {"kind": "polygon", "effect": "cut", "radius": 1, "points": left}
    finish(room, marked_document(strokes={"0.png": [stroke], "3.png": [stroke]}))
    cut, whole = (read_image(room / "panes" / name)[:, :, 0] == 1 for name in NAMES[:2])
    assert not cut[:, :150].any() and cut[:, 150:].any() and whole[:, :150].any()
    assert (room / "panes" / "3.png").exists(), "a photograph with nothing but a cut is marked, too"


def test_writing_again_replaces_what_was_written_and_nothing_else(room: Path) -> None:
    finish(room, marked_document((0, 1, 2)))
    finish(room, marked_document((1, 2)))
    assert sorted(path.name for path in (room / "panes").glob("*.png")) == ["1.png", "2.png"]
    Image.new("L", (300, 220), 1).save(room / "panes" / "4.png")
    with pytest.raises(InputError, match=r"not made by `glassplat annotate` \(4\.png\)"):
        open_session(room)
    assert (room / "panes" / "4.png").exists()


def test_a_record_that_names_other_files_removes_none(room: Path) -> None:
    finish(room, marked_document())
    (room / "panes" / "annotated.json").write_text(json.dumps(["../transforms.json", *NAMES[:3]]))
    finish(room, marked_document((1, 2)))
    assert (room / "transforms.json").exists()


@pytest.mark.parametrize("name", ["panes", "panes/sub", "panes/0.png", "annotations.json", "planes.json"])
def test_links_out_of_a_capture_are_not_followed(name: str, room: Path, tmp_path: Path) -> None:
    finish(room, marked_document())
    is_folder, elsewhere = not Path(name).suffix, tmp_path / "elsewhere"
    if (room / name).exists():
        (room / name).rename(elsewhere)
    else:
        elsewhere.mkdir()
        (elsewhere / "mine.png").write_bytes(b"mine")
        (room / "panes" / "annotated.json").write_text(json.dumps([*NAMES[:3], "sub/mine.png"]))
    before = sorted((path, path.read_bytes()) for path in (elsewhere.iterdir() if is_folder else [elsewhere]))
    (room / name).symlink_to(elsewhere)
    with pytest.raises(InputError, match="leads out of"):
        finish(room, marked_document((1, 2)))
    assert sorted((path, path.read_bytes()) for path in (elsewhere.iterdir() if is_folder else [elsewhere])) == before


@pytest.mark.parametrize("folder", ["../photos/", "/photos/", "a/../../photos/"])
def test_masks_stay_in_their_folder_wherever_the_photographs_lie(folder: str, tmp_path: Path) -> None:
    names = [f"{tmp_path if folder.startswith('/') else ''}{folder}{name}" for name in NAMES]
    (tmp_path / "room" / "images" / "a").mkdir(parents=True)
    root = write_colmap_room(tmp_path / "room", names)
    before = [(root / "images" / name).read_bytes() for name in names]
    finish(root, renamed(marked_document(), names))
    assert [(root / "images" / name).read_bytes() for name in names] == before
    assert sorted(path.name for path in (root / "panes").glob("*.png")) == NAMES[:3]
    assert [view.name for view in load_dataset(root).train if view.is_annotated] == names[1:3]


@pytest.mark.parametrize(
    "names", [["a.jpg", "a.png", "b.png", "c.png", "d.png"], ["1.jpg", "a/1.jpg", "b/1.jpg", "2.jpg", "3.jpg"]]
)
def test_a_mask_belongs_to_its_photograph_and_to_no_other_of_a_like_name(names: list[str], tmp_path: Path) -> None:
    root = write_colmap_room(tmp_path / "room", names)
    finish(root, renamed(marked_document((0, 3)), names))
    dataset = load_dataset(root)
    annotated = {view.name for view in (*dataset.train, *dataset.test) if view.is_annotated}
    assert annotated == {names[0], names[3]}


@pytest.mark.parametrize("written", range(6))
def test_an_interrupt_at_any_file_loses_nothing(written: int, room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files in the order of writing: the record, three masks, the planes, the record again."""
    places: list[str] = []

    def replace(source: str, target: str) -> None:
        if len(places) == written:
            (room / "panes" / ".0.0123456789ab.tmp.png").write_text("what a killed writer leaves behind")
            raise KeyboardInterrupt
        places.append(target)
        replace_file(source, target)

    replace_file = os.replace
    session = open_session(room)
    saved(session, marked_document(strokes={"0.png": [EVERYTHING]}))
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(os, "replace", replace)
        session.finish()
    assert len(places) == written
    finish(room, marked_document((1, 2)))
    assert sorted(path.name for path in (room / "panes").glob("[!.]*.png")) == ["1.png", "2.png"]
    assert load_dataset(room).pane_labels == (1,)
    Image.new("L", (300, 220), 1).save(room / "panes" / "0.png")
    with pytest.raises(InputError, match=r"not made by `glassplat annotate` \(0\.png\)"):
        open_session(room)


def test_masks_not_made_by_annotate_are_refused(room: Path) -> None:
    (room / "masks").mkdir()
    Image.new("L", (300, 220), 1).save(room / "masks" / "0.png")
    with pytest.raises(InputError, match="marked by masks that were not made by `glassplat annotate`"):
        open_session(room)
    (room / "transforms.json").rename(room / "transforms_train.json")
    (room / "masks" / "0.png").rename(room / "masks" / "MirrorMask_0.png")
    (room / "panes").mkdir()
    with pytest.raises(InputError, match="marked by masks that were not made by `glassplat annotate`"):
        open_session(room)


@pytest.mark.parametrize("unmarked", [{"version": 1, "panes": []}, marked_document(())])
def test_the_last_pane_can_be_unmarked(unmarked: dict, tmp_path: Path) -> None:
    names = ["left/0.png", "left/1.png", "right/2.png", "3.png", "4.png"]
    root = write_colmap_room(tmp_path / "room", names)
    before = sorted(root.rglob("*"))
    finish(root, renamed(marked_document(), names))
    removed = "planes.json, panes/left/0.png, panes/left/1.png, panes/right/2.png"
    told = finish(root, unmarked)
    assert told == {"masks": [], "planes": [], "told": f"no pane is marked; removed the earlier output: {removed}"}
    assert sorted(root.rglob("*")) == sorted([*before, root / "annotations.json"])
    with pytest.raises(InputError, match="no pane is known yet"):
        finish(root, unmarked)


def test_unmarking_removes_only_own_files(room: Path) -> None:
    nothing = {"version": 1, "panes": []}
    finish(room, marked_document())
    with pytest.raises(InputError, match="no pane is known yet"):
        finish(room, marked_document((0,)))
    assert (room / "panes" / "1.png").exists()
    session = open_session(room)
    saved(session, nothing)
    Image.new("L", (300, 220), 1).save(room / "panes" / "4.png")
    with pytest.raises(InputError, match=r"not made by `glassplat annotate` \(4\.png\)"):
        session.finish()
    assert len(list((room / "panes").glob("*.png"))) == 4
    (room / "panes" / "4.png").unlink()
    planes = (room / "planes.json").read_text()
    (room / "planes.json").write_text(planes + " ")
    assert "planes.json stays: it was not written here" in session.finish()["told"]
    assert not (room / "panes").exists() and (room / "planes.json").read_text() == planes + " "


@pytest.mark.parametrize("changed", ["before", "since"])
def test_planes_of_other_programs_are_not_replaced(changed: str, room: Path) -> None:
    if changed == "since":
        finish(room, marked_document())
        assert finish(room, marked_document()), "what was made here is"
    own = [{"label": 2, "center": [0, 0, 2], "normal": [0, 0, -1], "tangent": [1, 0, 0], "half_sizes": [1, 1]}]
    (room / "planes.json").write_text(json.dumps(own))
    with pytest.raises(InputError, match=r"planes\.json was not made by .*; nothing was written\. Move it away"):
        finish(room, marked_document())
    assert json.loads((room / "planes.json").read_text()) == own
    (room / "planes.json").unlink()
    assert finish(room, marked_document())["masks"] == NAMES[:3]


def test_a_record_of_an_earlier_version_lists_masks_only(room: Path) -> None:
    finish(room, marked_document())
    (room / "panes" / "annotated.json").write_text(json.dumps(NAMES[:3]))
    assert "planes.json stays" in finish(room, {"version": 1, "panes": []})["told"]
    assert not (room / "panes").exists() and (room / "planes.json").exists()


def test_marks_saved_by_another_program_are_written(room: Path) -> None:
    session = open_session(room)
    saved(session, marked_document())
    (room / "annotations.json").write_text(json.dumps(marked_document((0, 1, 2, 3))))
    assert session.finish()["masks"] == NAMES[:4]
    (room / "annotations.json").unlink()
    assert session.finish()["told"].startswith("no pane is marked; removed the earlier output")


def test_without_a_pane_nothing_is_written(room: Path) -> None:
    with pytest.raises(InputError, match="no pane is known yet"):
        finish(room, marked_document((0,)))
    assert not (room / "panes").exists() and not (room / "planes.json").exists()


def test_the_nearer_pane_hides_the_farther_one(room: Path) -> None:
    behind = Pane(FRONT.center + np.array([0.3, 0.0, 0.5]), FRONT.normal, FRONT.tangent, (0.8, 0.5))
    cameras = [NumpyCamera.from_camera(camera_from(place, FRONT.center)) for place in PLACES]
    panes = []
    for label, pane in enumerate((behind, FRONT), start=1):
        corners = pane.at(np.array([-1.0, 1, 1, -1]), np.array([-1.0, -1, 1, 1]))
        places = [
            {name: camera.project(c).tolist() for name, camera in zip(NAMES, cameras, strict=True)} for c in corners
        ]
        (marked,) = parse_document(marked_document(label=label, corners=places), "here")
        numbers = {name: number for number, name in enumerate(NAMES)}
        panes.append((marked, fit_pane(marked.marks(numbers), cameras, "rectangle")))
    for order in (panes, panes[::-1]):
        labels = pane_labels(NAMES[1], cameras[1], order)
        truth = label_image(camera_from(PLACES[1], FRONT.center), [behind, FRONT]).numpy()
        assert (labels != truth).mean() < 0.002


def test_an_outline_that_passes_the_camera_is_cut_off() -> None:
    camera = NumpyCamera.from_camera(camera_from((0.0, 0.0, 0.0), np.array([0.0, 0.0, 1.0])))
    floor = np.array([[-5.0, 1, -5], [5, 1, -5], [5, 1, 5], [-5, 1, 5]])
    mask = fill_polygon(project_outline(camera, floor), (300, 220))
    horizon = 110 + 240 * 1 / 5
    rows = np.flatnonzero(mask.any(axis=1))
    assert rows.min() == pytest.approx(horizon, abs=2) and rows.max() == 219
    behind = floor - [0, 0, 10]
    assert not fill_polygon(project_outline(camera, behind), (300, 220)).any()


def test_an_outline_that_passes_the_camera_keeps_its_edges_straight() -> None:
    camera = NumpyCamera.from_camera(camera_from((0.0, 0.0, 0.0), np.array([0.0, 0.0, 1.0])))
    wall = np.array([[-2.0, -1, 6], [2.5, -1, -20], [2.5, 1, -20], [-2, 1, 6]])
    mask = fill_polygon(project_outline(camera, wall), (300, 220))
    x, y = np.meshgrid(np.arange(300) + 0.5, np.arange(220) + 0.5)
    rays = camera.rays(np.stack([x, y], axis=-1))
    normal = np.cross(wall[1] - wall[0], wall[3] - wall[0])
    met = rays * (wall[0] @ normal / (rays @ normal))[..., None]
    truth = (np.abs(met[..., 1]) < 1) & (met[..., 0] > -2) & (met[..., 2] > 0)
    assert 0.1 < truth.mean() < 0.9 and (mask != truth).mean() < 1e-3


def test_the_restore_brush_stays_within_the_pane() -> None:
    mask = np.zeros((40, 40), dtype=bool)
    mask[10:30, 10:30] = True
    (pane,) = parse_document(
        marked_document(
            strokes={
                "0.png": [
                    {"kind": "brush", "effect": "cut", "radius": 8, "points": [[20, 20]]},
                    {"kind": "brush", "effect": "keep", "radius": 4, "points": [[20, 20], [60, 20]]},
                ]
            }
        ),
        "here",
    )
    found = apply_strokes(mask, pane.strokes["0.png"])
    assert found[20, 20] and not found[14, 20] and not found[20, 33] and not (found & ~mask).any()


@pytest.mark.parametrize("way", [1, -1])
def test_a_self_intersecting_cut_is_filled_completely(way: int) -> None:
    """As the page shows it: the centre of a pentagram is inside, and so is an area enclosed by two loops."""
    angles = way * 2 * 2 * np.pi / 5 * np.arange(5)
    star = 50 + 40 * np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    found = fill_polygon(star, (100, 100))
    assert found[45:55, 45:55].all() and found[15, 50] and not found[80, 50] and not found[2, 2]
    np.testing.assert_array_equal(fill_polygon(np.concatenate([star, star]), (100, 100)), found)


def test_an_edge_of_a_polygon_costs_its_rows_and_not_their_pixels() -> None:
    square = np.array([[0.0, 0.0], [900.0, 0.0], [900.0, 600.0], [0.0, 600.0]])
    tracemalloc.start()
    assert fill_polygon(square, (900, 600)).all()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 5 * 900 * 600, "two bytes a pixel for the turns and one for the mask"


def test_masks_are_undistorted_with_their_photographs(room: Path) -> None:
    transforms = json.loads((room / "transforms.json").read_text()) | {"k1": -0.2, "k2": 0.02, "p1": 0.0, "p2": 0.0}
    (room / "transforms.json").write_text(json.dumps(transforms))
    view = load_dataset(room).train[0]
    reader = view.read_photo
    assert isinstance(reader, PhotoFile) and reader.pixel_map.lens is not None
    labels = np.zeros((view.camera.height, view.camera.width), dtype=np.uint8)
    labels[60:160, 80:220] = 1
    bent = resample_to_photograph(view, labels)
    assert bent.shape == (220, 300)
    back = reader.pixel_map.map_labels(bent)
    assert (back != labels).mean() < 0.02


def test_the_command_needs_a_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "photographs").mkdir()
    assert main(["annotate", str(tmp_path / "photographs")]) == 2
    assert "is not a readable capture" in " ".join(capsys.readouterr().err.split())


def test_annotate_suggests_prepare_for_photographs_without_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    (folder / "1.HEIC").write_bytes(b"")
    assert main(["annotate", str(folder)]) == 2
    assert f"glassplat prepare {folder} --output CAPTURE" in " ".join(capsys.readouterr().err.split())
    (folder / "recipe.json").touch()
    assert main(["annotate", str(folder)]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "This is a run" in told and "glassplat prepare" not in told


def test_a_damaged_document_is_named(room: Path) -> None:
    (room / "annotations.json").write_text('{"version": 1}')
    with pytest.raises(InputError, match=r"annotations\.json has no panes"):
        open_session(room)


def test_a_wrong_order_of_corners_gets_a_warning(room: Path) -> None:
    session = open_session(room)
    document = marked_document()
    _, second, _, fourth = document["panes"][0]["corners"]
    second[NAMES[0]], fourth[NAMES[0]] = fourth[NAMES[0]], second[NAMES[0]]  # The reverse order: no sides cross.
    answer = saved(session, document)["panes"][0]
    assert "do not form a rectangle" in answer["message"] or "pixels off" in answer["message"]


def test_the_suggested_photograph_lowers_the_uncertainty(room: Path) -> None:
    session = open_session(room)
    two = saved(session, marked_document((0, 2)))["panes"][0]
    best = two["next"][0]
    assert best["uncertainty"] < two["uncertainty"]
    three = saved(session, marked_document((0, 2, best["view"])))["panes"][0]
    assert three["uncertainty"] == pytest.approx(best["uncertainty"], rel=0.3)


def test_only_panes_that_have_changed_are_fitted_again(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = []
    monkeypatch.setattr("glassplat.annotate.session.fit_pane", lambda *given: fitted.append(given) or fit_pane(*given))
    opened, document = open_session(room), marked_document()
    document["panes"] += marked_document(label=2)["panes"]
    first = saved(opened, document)["panes"]
    assert len(fitted) == 2 and [answer["label"] for answer in first] == [1, 2]
    document["panes"][0]["strokes"] = {"0.png": [EVERYTHING]}
    assert saved(opened, document)["panes"] == first and len(fitted) == 2
    document["panes"][1]["corners"][0]["0.png"][0] += 3
    again = saved(opened, document)["panes"]
    assert again[0] == first[0] and again[1]["error"] > first[1]["error"] and len(fitted) == 3
    document["panes"][1]["shape"] = "polygon"
    saved(opened, document)
    assert len(fitted) == 4


CROSSED = ((0, 0), (1, 2), (2, 1), (3, 3))


@pytest.mark.parametrize("shape", ["rectangle", "polygon"])
def test_crossing_sides_are_reported(shape: str, room: Path) -> None:
    document = marked_document(shape=shape)
    session, corners = open_session(room), document["panes"][0]["corners"]
    assert saved(session, document)["panes"][0]["message"] == ""
    for crossing in ({NAMES[0]}, {NAMES[0], NAMES[1], NAMES[2]}):
        swapped = [{**corners[one], **{view: corners[other][view] for view in crossing}} for one, other in CROSSED]
        for marks in (swapped, [{NAMES[0]: places[NAMES[0]]} for places in swapped]):
            answer = saved(session, marked_document(shape=shape, corners=marks))["panes"][0]
            assert answer["message"] == "the sides cross in 0.png: click the corners in order around the pane"
