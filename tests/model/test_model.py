"""Models: loaded, rendered, edited and saved."""

from __future__ import annotations

import base64
import copy
import dataclasses
import io
import pickle
from pathlib import Path
from typing import Any
from urllib.request import HTTPCookieProcessor, build_opener

import numpy as np
import pytest
import torch
from PIL import Image

import glassplat
from glassplat import Camera, Gaussians, InputError, Model, Planar, PlanarRecipe, Scene, SplatRecipe, View
from glassplat.model.model import name_cameras
from glassplat.options import CLEAR_GLASS
from glassplat.render.deferred import Deferred
from glassplat.render.splat import Splat
from glassplat.render.traced import Traced
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Environment
from glassplat.training.densify import as_discs
from tests.cli.tiny_run import write_run
from tests.render.tiny_scene import random_gaussians
from tests.training.tiny_capture import tiny_capture, true_scene

LABEL = 1


def model() -> Model:
    cameras = {view.name: view.camera for view in tiny_capture().train}
    return Model(true_scene(), PlanarRecipe(background=(0.0, 0.0, 0.0)), cameras, "tiny")


def bare() -> Model:
    scene = true_scene()
    primary = dataclasses.replace(scene.primary, channels={})
    return Model(Scene(primary, scene.extent), SplatRecipe(), model().cameras, "bare")


def test_a_run_is_loaded_and_rendered_as_its_renderer_does(tmp_path: Path) -> None:
    loaded = glassplat.load(write_run(tmp_path / "run"), device="cpu")
    assert repr(loaded) == "Model('run': planar, 30 Gaussians, 1 pane, 6 cameras)"
    assert (loaded.panes, loaded.layers[0], loaded.path) == ((LABEL,), "rgb", tmp_path / "run")
    frame = loaded.render("2.png", layers=["reflection", "depth"])
    torch.testing.assert_close(frame.rgb, Planar()(true_scene(), loaded.cameras["2.png"]).rgb)
    assert {"reflection", "depth"} == set(frame.layers), "what was not asked for stays inside"
    again = loaded.render("2.png", layers=(name for name in ("reflection", "depth")))  # type: ignore[arg-type]
    assert torch.equal(again.layers["depth"], frame.layers["depth"])


def test_gradients_reach_the_scene_and_the_camera() -> None:
    whole = model()
    camera = whole.cameras["2.png"]
    pose = camera.cam_from_world.clone().requires_grad_()
    logits = whole.scene.planes.logit_reflectances.clone().requires_grad_()
    colors = whole.scene.primary.sh.clone().requires_grad_()
    edited = whole.with_parameters({"planes.logit_reflectances": logits, "primary.sh": colors})
    edited.render(dataclasses.replace(camera, cam_from_world=pose)).rgb.sum().backward()
    for tensor in (pose, logits, colors):
        assert tensor.grad is not None and float(tensor.grad.abs().sum()) > 0


def test_every_layer_is_an_image(tmp_path: Path) -> None:
    whole = model()
    for layer in whole.layers:
        image = whole.image("2.png", layer)
        assert image.shape == (28, 40, 3) and not image.requires_grad
        assert 0 <= float(image.min()) <= float(image.max()) <= 1
    with pytest.raises(InputError, match=r"layers is 'depth'; expected a sequence"):
        whole.render("2.png", layers="depth")
    with pytest.raises(InputError, match="camera is 3; expected one Camera, or the name"):
        whole.render(3)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^camera is \[Camera.{,100}\.\.\.; expected one Camera"):
        whole.render([*whole.cameras.values()])  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"planar renders no layer base; expected .*reflection"):
        whole.image("2.png", "base")
    with pytest.raises(InputError, match=r"no layer reflection; expected .* rgb, normal, depth, alpha; .* no panes"):
        whole.without_glass().image("2.png", "reflection")
    with pytest.raises(InputError, match=r"there is no camera 'nobody\.png'; expected one of .*0\.png"):
        whole.render("nobody.png")


def test_every_public_object_has_a_repr_of_one_line() -> None:
    whole = model()
    data = tiny_capture()
    scene = whole.scene
    for thing in (whole, scene, scene.environment, whole.cameras["2.png"], whole.render("2.png"), data, data.train[0]):
        assert type(thing).__name__ in repr(thing) and "\n" not in repr(thing) and len(repr(thing)) < 300
    assert repr(whole.scene.planes) == f"Planes(labels=({LABEL},), mirrors=(), R0=[0.3])"


def test_a_notebook_shows_a_picture_of_the_model() -> None:
    shown = model()._repr_html_()
    head, _, rest = shown.partition("base64,")
    picture = Image.open(io.BytesIO(base64.b64decode(rest.partition('"')[0])))
    assert "30 Gaussians" in head and picture.size == (40, 28)
    expected = dataclasses.replace(model(), cameras={})._repr_html_()
    assert "0 cameras" in expected and "<img" not in expected


def test_a_model_is_shown_in_the_browser_until_it_is_stopped() -> None:
    viewer = model().show()
    try:
        assert viewer.address in repr(viewer)
        with build_opener(HTTPCookieProcessor()).open(viewer.address) as answer:
            assert answer.status == 200
    finally:
        viewer.stop()


def test_edits_are_new_models() -> None:
    whole = model()
    before = whole.image("2.png", "strength")
    mirror, without = whole.with_mirrors(LABEL), whole.without_glass()
    assert float(mirror.image("2.png", "strength").mean()) > 1.5 * float(before.mean())
    assert without.panes == () and torch.equal(without.image("2.png"), whole.without_pane(LABEL).image("2.png"))
    assert float(whole.with_reflectance(LABEL, 0.01).image("2.png", "strength").mean()) < float(before.mean())
    moved = whole.shift_pane(LABEL, 0.1).tilt_pane(LABEL, 5.0)
    assert not torch.equal(moved.scene.planes.centers, whole.scene.planes.centers)
    assert not torch.equal(moved.scene.planes.normals, whole.scene.planes.normals)
    assert torch.equal(whole.image("2.png", "strength"), before)
    with pytest.raises(ValueError, match="no pane 7"):
        whole.without_pane(7)


def test_one_of_two_panes_is_removed_with_its_glass() -> None:
    two = model().with_pane((3.0, 0.0, 2.0), (0.0, 0.0, 1.0), (0.5, 0.4))
    assert two.panes == (1, 2) and len(two.scene.glass) > len(model().scene.glass)
    assert float(two.scene.planes.base_reflectances[1]) == pytest.approx(CLEAR_GLASS)
    back = two.without_pane(2)
    assert back.panes == (1,) and torch.equal(back.scene.glass.means, model().scene.glass.means)


def test_a_mirror_added_to_a_scene_without_panes_reflects_it() -> None:
    plain = bare()
    mirror = plain.with_pane((0.0, 0.0, 1.5), (0.0, 0.0, -1.0), (2.0, 2.0), base_reflectance=1)
    assert mirror.recipe.method == "planar" and mirror.scene.planes.mirrors == (1,)
    strength, reflection = (mirror.image("2.png", layer) for layer in ("strength", "reflection"))
    assert float(strength.mean()) > 0.8 and float(reflection.std()) > 0.01
    # Objects behind the mirror do not show through between the discs of its glass.
    assert (
        float(strength[strength > 0].median()) > 0.999 and float((strength[strength > 0] < 0.99).float().mean()) < 0.1
    )
    discs = plain.with_scene(true_scene())
    discs = dataclasses.replace(discs, recipe=SplatRecipe(primitive="disc"))
    with pytest.raises(ValueError, match="panes cannot be put into a scene of splat"):
        discs.with_pane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0))


@pytest.mark.parametrize(
    ("normal", "half_sizes", "tangent", "message"),
    [
        ((0.0, 0.0, 0.0), (1.0, 1.0), None, "expected two directions"),
        ((0.0, 0.0, 1.0), (1.0, 0.0), None, "sizes above 0"),
        ((0.0, 0.0, float("nan")), (1.0, 1.0), None, "expected finite numbers"),
        ((0.0, 0.0, 1.0), (1.0, 1.0), (0.0, 0.0, 3.0), "expected two directions"),
        ((0.0, 1.0), (1.0, 1.0), None, "expected 3, 3, 3 and 2"),
    ],
)
def test_an_invalid_pane_is_refused(normal: tuple, half_sizes: tuple, tangent: tuple | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        model().with_pane((0.0, 0.0, 0.0), normal, half_sizes, tangent=tangent)


@pytest.mark.parametrize("label", [0, -1, 256])
def test_a_label_beyond_the_range_of_files_is_refused(label: int) -> None:
    with pytest.raises(ValueError, match=rf"the labels \[{label}\]; expected 1 to 255"):
        bare().with_pane((0.0, 0.0, 1.5), (0.0, 0.0, -1.0), (2.0, 2.0), label=label)
    assert bare().with_pane((0.0, 0.0, 1.5), (0.0, 0.0, -1.0), (2.0, 2.0), label=255).panes == (255,)
    with pytest.raises(ValueError, match=r"the scene has a pane 1 already; its panes are \[1\]"):
        model().with_pane((0.0, 0.0, 1.5), (0.0, 0.0, -1.0), (2.0, 2.0), label=1)


@pytest.mark.parametrize(("name", "tolerance"), [("a.ply", 1e-6), ("a.spz", 0.1), ("folder", 0.0)])
def test_saved_models_are_loaded_again(name: str, tolerance: float, tmp_path: Path) -> None:
    whole = model()
    path = whole.save(tmp_path / "out" / name)
    again = glassplat.load(path, device="cpu")
    assert list(again.cameras) == list(whole.cameras) and again.panes == whole.panes
    torch.testing.assert_close(again.image("2.png"), whole.image("2.png"), atol=tolerance, rtol=0)
    with pytest.raises(FileExistsError, match="nothing was written"):
        whole.save(path)
    darker = whole.with_reflectance(LABEL, 0.01)
    darker.save(path, overwrite=True)
    assert float(glassplat.load(path, device="cpu").scene.planes.base_reflectances) == pytest.approx(0.01, rel=1e-3)
    assert not [left for left in path.parent.iterdir() if left.name.startswith(".")]


def test_a_model_is_saved_in_several_formats_next_to_each_other(tmp_path: Path) -> None:
    environment = Environment(torch.zeros(6, 4, 4, 3))
    whole = model().with_scene(dataclasses.replace(model().scene, environment=environment))
    for name in ("a.ply", "a.spz", "a.glb"):
        whole.save(tmp_path / name)
    darker = whole.with_reflectance(LABEL, 0.01)
    with pytest.raises(FileExistsError, match=r"planes\.json already exists; nothing was written"):
        darker.save(tmp_path / "b.ply")
    assert not (tmp_path / "b.ply").exists()


DISCS = {"primary": as_discs(true_scene().primary)}
NO_PANES, PLAIN = {"planes": Planes.empty()}, PlanarRecipe(background=(0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("name", "recipe", "parts", "lost"),
    [
        ("a.ply", PLAIN, {}, None),
        ("a.glb", PLAIN, {}, None),
        ("a.spz", PLAIN, {}, "the intensity of Gaussians in panes"),
        ("a.ply", PlanarRecipe.paper(), {}, "fresnel=schlick, blend=srgb, nearest=True"),
        ("a.ply", SplatRecipe(background=(0.0, 0.0, 0.0)), NO_PANES, None),
        ("a.ply", SplatRecipe(background=(1.0, 1.0, 1.0)), NO_PANES, "background=(1.0, 1.0, 1.0)"),
        ("a.ply", PLAIN, {"surroundings": true_scene().primary}, "what glossy surfaces mirror"),
        ("a.ply", PLAIN, {"photographer": true_scene().primary}, "the photographer"),
        ("a.spz", SplatRecipe(background=(0.0, 0.0, 0.0)), NO_PANES | DISCS, "that Gaussians are discs"),
        ("a.sog", SplatRecipe(background=(0.0, 0.0, 0.0)), NO_PANES | DISCS, "that Gaussians are discs"),
        ("a.glb", SplatRecipe(background=(0.0, 0.0, 0.0)), NO_PANES | DISCS, None),
    ],
)
def test_saving_lists_what_a_splat_file_leaves_out(
    name: str, recipe: Any, parts: dict, lost: str | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    if name.endswith(".sog"):
        pytest.importorskip("gaussforge")
    whole = model()
    scene = dataclasses.replace(whole.scene, **parts)
    path = dataclasses.replace(whole, scene=scene, recipe=recipe).save(tmp_path / name)
    expected = f"{path} leaves out {lost}; a folder, saved without a suffix, holds everything"
    assert caplog.messages == ([] if lost is None else [expected])


def test_a_folder_that_is_not_a_saved_model_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / "a.jpg").touch()
    with pytest.raises(FileExistsError, match=r"not empty; nothing was written. Choose a new folder$"):
        model().save(tmp_path / "photographs", overwrite=True)
    assert (tmp_path / "photographs" / "a.jpg").exists()


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.0, 0.0, -2.0), (1.0, -0.2, 0.5)])
def test_the_first_side_of_a_pane_is_horizontal_by_default(normal: tuple[float, float, float]) -> None:
    pane = bare().with_pane((0.0, 0.0, 1.5), normal, (2.0, 1.0)).scene.planes
    assert abs(float(pane.tangents[0, 1])) < 0.05, "the cameras of this scene are held upright, y down"
    flat = bare().with_pane((0.0, 1.0, 0.0), (0.0, 1.0, 0.0), (2.0, 1.0)).scene.planes
    assert abs(float(flat.normals[0] @ flat.tangents[0])) < 1e-5


def test_a_model_without_cameras_gets_an_orbit() -> None:
    blind = dataclasses.replace(model(), cameras={})
    assert len(blind.orbit(3)) == 3 and len(blind.viewpoints) > 1
    assert blind.clean()[1].keys() == model().clean()[1].keys()
    viewer = blind.show()
    viewer.stop()


def test_an_empty_model_is_described_as_empty() -> None:
    nothing = model().with_scene(Scene(Gaussians.empty(1, channels=("log_intensity",)), 1.0))
    with pytest.raises(InputError, match="cannot be cleaned; expected at least one"):
        nothing.clean()
    with pytest.raises(InputError, match="the scene has no Gaussians; expected"):
        _ = dataclasses.replace(nothing, cameras={}).viewpoints


def test_cameras_of_one_name_are_all_kept() -> None:
    cameras = list(model().cameras.values())
    names = ("a", "a", "a #2", "b", "a")
    assert list(name_cameras(zip(names, cameras, strict=False))) == ["a", "a #2", "a #2 #2", "b", "a #3"]


def test_a_model_without_cameras_is_saved_as_a_file_and_as_no_folder(tmp_path: Path) -> None:
    blind = dataclasses.replace(model(), cameras={})
    with pytest.raises(InputError, match=r"without cameras cannot be saved as the folder .*; give it some"):
        blind.save(tmp_path / "folder")
    assert not (tmp_path / "folder").exists()
    assert len(glassplat.load(blind.save(tmp_path / "a.ply"), device="cpu").cameras) > 0


def test_panes_of_an_overwritten_file_are_not_reused(tmp_path: Path) -> None:
    model().save(tmp_path / "a.ply")
    with pytest.raises(FileExistsError, match=r"planes\.json"):
        bare().save(tmp_path / "b.ply")
    bare().save(tmp_path / "b.ply", overwrite=True)
    assert glassplat.load(tmp_path / "b.ply", device="cpu").panes == ()
    bare().save(tmp_path / "b.spz")
    assert glassplat.load(tmp_path / "b.spz", device="cpu").panes == ()


@pytest.mark.parametrize("name", ["environment.png", "environment.json"])
def test_an_existing_environment_is_not_overwritten(name: str, tmp_path: Path) -> None:
    whole = model()
    mirroring = whole.with_scene(dataclasses.replace(whole.scene, environment=Environment(torch.zeros(6, 4, 4, 3))))
    (tmp_path / name).write_text("somebody's")
    with pytest.raises(FileExistsError, match=rf"{name} already exists; nothing was written"):
        mirroring.save(tmp_path / "a.ply")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [(name, "somebody's")]
    whole.save(tmp_path / "plain.ply")
    assert (tmp_path / name).read_text() == "somebody's", "a scene without an environment writes none"
    mirroring.save(tmp_path / "a.ply", overwrite=True)
    assert b"somebody's" not in (tmp_path / name).read_bytes()


def test_a_model_is_saved_as_a_page_and_as_nothing_unknown(tmp_path: Path) -> None:
    assert "<html" in model().save(tmp_path / "page.html").read_text()[:200]
    with pytest.raises(InputError, match=r"expected a name that ends in \.ply, .*\.html, or a folder's"):
        model().save(tmp_path / "a.obj")


@pytest.mark.parametrize("name", ["none", "none.ply"])
def test_missing_files_are_named(name: str, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=f"{name} does not exist; expected a run"):
        glassplat.load(tmp_path / name)


def test_a_camera_points_at_its_target() -> None:
    camera = Camera.look_at((0, -1, -4), (0, 0, 0), up=(0, -1, 0), width=64, height=48)
    pixel, depth = camera.project(torch.tensor([[0.0, 0.0, 0.0], [0.0, -0.5, 0.0], [0.5, 0.0, 0.0]]))
    torch.testing.assert_close(pixel[0], torch.tensor([32.0, 24.0]), atol=1e-4, rtol=0)
    assert float(depth[0]) == pytest.approx(17**0.5)
    assert float(pixel[1, 1]) < 24 and float(pixel[2, 0]) > 32
    with pytest.raises(ValueError, match="expected another place"):
        Camera.look_at((0, 0, 0), (0, 1, 0), up=(0, -1, 0))


def test_metrics_are_those_of_the_test_views() -> None:
    assert model().evaluate(tiny_capture())["psnr"] > 40


def test_a_scene_in_double_precision_is_measured_and_published(tmp_path: Path) -> None:
    whole = model()
    double = whole.with_parameters({name: tensor.double() for name, tensor in whole.scene.parameters().items()})
    assert double.save(tmp_path / "page.html").is_file()
    assert double.evaluate(tiny_capture())["psnr"] == pytest.approx(whole.evaluate(tiny_capture())["psnr"], abs=1e-3)


def test_photographs_over_another_background_are_not_measured() -> None:
    white, black = (dataclasses.replace(tiny_capture(), background=(value,) * 3) for value in (1.0, 0.0))
    expected = r"laid over \(1.0, 1.0, 1.0\), but .* over \(0.0, 0.0, 0.0\); .* background=\(0.0, 0.0, 0.0\)"
    for one in (model(), bare()):
        with pytest.raises(InputError, match=expected):
            one.evaluate(white)
    assert model().evaluate(black)["psnr"] > 40


def test_metrics_compare_with_photographs_including_the_photographer() -> None:
    plain = model()
    drawn = random_gaussians(40, (0.0, 0.0, 0.0), seed=5)
    somebody = drawn.with_tensors({name: tensor.float() for name, tensor in drawn.tensors().items()})
    somebody = somebody.with_tensors({"log_scales": somebody.log_scales + 1})
    with_somebody = plain.with_scene(dataclasses.replace(plain.scene, photographer=somebody))
    psnr = [one.evaluate(tiny_capture())["psnr"] for one in (plain, with_somebody)]
    assert psnr[1] < psnr[0] - 1


def test_gaussians_of_a_model_are_plain_data() -> None:
    primary = model().scene.primary
    assert isinstance(primary, Gaussians) and len(primary.concat(primary)) == 2 * len(primary)
    own = Gaussians(primary.means, primary.quats, primary.log_scales, primary.logit_opacities, primary.sh)
    assert own.active_sh_degree == own.max_sh_degree == 2, "colours that are given are used"
    for one, other in (
        (primary, own),
        (own, primary),
        (own, dataclasses.replace(own, sh=own.sh[:, :1], active_sh_degree=0)),
    ):
        with pytest.raises(ValueError, match=r"one set has columns .*; expected the same of both"):
            one.concat(other)


def test_objects_with_tensors_differ_from_their_copies() -> None:
    whole = model()
    parts = whole.scene.primary, whole.scene.planes, whole.cameras["2.png"], tiny_capture().points
    for thing in (whole, whole.scene, *parts):
        assert thing in {thing} and thing not in [copy.deepcopy(thing)]


@pytest.mark.parametrize(
    ("name", "shape", "expected"),
    [
        ("primary.means", (30, 2), r"means has shape \(30, 2\); expected \(30, 3\)"),
        ("primary.quats", (30, 3), r"quats has shape \(30, 3\); expected \(30, 4\)"),
        ("primary.log_scales", (30, 1), r"log_scales has .*; expected \(30, 2\) or \(30, 3\)"),
        ("primary.logit_opacities", (30, 1), r"logit_opacities has .*; expected \(30,\)"),
        ("primary.log_intensity", (29,), r"log_intensity has .*; expected \(30,\)"),
        ("planes.centers", (1, 2), r"centers has shape \(1, 2\); expected \(1, 3\)"),
        ("planes.logit_reflectances", (1, 1), r"logit_reflectances has .*; expected \(1,\)"),
        ("planes.half_sizes", (1, 3), r"half_sizes has .*; expected \(1, 2\)"),
    ],
)
def test_tensors_of_another_shape_are_refused(name: str, shape: tuple[int, ...], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        model().with_parameters({name: torch.zeros(shape)})
    with pytest.raises(TypeError, match="is a list; expected a tensor"):
        model().with_parameters({name: [0.0]})  # type: ignore[dict-item]


def test_second_derivatives_are_refused_or_zero() -> None:
    means = model().scene.primary.means.clone().requires_grad_()
    image = model().with_parameters({"primary.means": means}).render("2.png").rgb
    first, second = (torch.autograd.grad(loss, means, create_graph=True)[0] for loss in (image.sum(), (image**2).sum()))
    assert not first.requires_grad and second.requires_grad
    with pytest.raises(RuntimeError, match="differentiate twice"):
        second.sum().backward()


def test_a_model_in_double_precision_is_rendered_from_its_cameras() -> None:
    double = model().to(torch.float64)
    assert double.render("2.png").rgb.dtype == torch.float64
    torch.testing.assert_close(double.image("2.png").float(), model().image("2.png"))
    assert double.to("cpu").cameras is double.cameras
    with pytest.raises(ValueError, match="device is 'gpu'; expected auto, cpu or cuda"):
        double.to("gpu")


@pytest.mark.parametrize("shape", [(30, 5, 3), (30, 25, 3), (30, 4), (30, 4, 4)])
def test_colours_that_are_no_harmonics_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(
        ValueError, match=r"sh has shape \(30, .*; expected \(N, K, 3\) with K one of \(0, 1, 4, 9, 16\)"
    ):
        dataclasses.replace(true_scene().primary, sh=torch.zeros(shape))


@pytest.mark.parametrize("renderer", [Splat, Planar, Deferred, Traced])
def test_a_background_is_a_colour(renderer: type) -> None:
    with pytest.raises(ValueError, match=r"background is \(0.1, 0.2, 0.3, 0.4\); expected three numbers, sRGB"):
        renderer((0.1, 0.2, 0.3, 0.4))


def test_views_in_memory_are_pickled_and_invalid_arguments_refused() -> None:
    scene, camera = true_scene(), model().cameras["2.png"]
    with pytest.raises(TypeError, match="means is a ndarray; expected a tensor"):
        dataclasses.replace(scene.primary, means=scene.primary.means.numpy())
    kept = pickle.loads(pickle.dumps(tiny_capture().train[0]))
    assert torch.equal(kept.photo, tiny_capture().train[0].photo)
    with pytest.raises(ValueError, match="the pixels of a are a ndarray; expected a tensor"):
        View.in_memory("a", camera, photo=np.zeros((28, 40, 3), np.uint8))  # type: ignore[arg-type]
    for photo in (torch.zeros(28, 40, 3), torch.zeros(40, 28, 3, dtype=torch.uint8)):
        with pytest.raises(ValueError, match=r"pixels of a are .*; expected a tensor of uint8 \[28, 40, 3\]"):
            View.in_memory("a", camera, photo=photo)
    with pytest.raises(ValueError, match=r"cam_from_world has shape \(3, 4\); expected a tensor \[4, 4\]"):
        dataclasses.replace(camera, cam_from_world=camera.cam_from_world[:3])
    with pytest.raises(ValueError, match=r"eye, target or up has shape \(2,\); expected three numbers"):
        Camera.look_at((0, 0), (0, 0, 1), up=(0, -1, 0))
    with pytest.raises(InputError, match="dataset is 'captures/shop'; expected what"):
        model().evaluate("captures/shop")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="the scene has no pane '1'; the panes are 1"):
        model().with_mirrors("1")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="fov_rad is 0; expected radians between 0 and pi"):
        Camera.look_at((0, 0, 0), (0, 0, 1), up=(0, -1, 0), fov_rad=0)
