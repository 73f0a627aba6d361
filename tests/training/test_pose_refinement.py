"""Cameras are corrected with the scene, stored with it, and restored; test cameras follow their photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from glassplat.captures.colmap import read_model
from glassplat.captures.dataset import Dataset, load_dataset, with_corrected_cameras
from glassplat.captures.view import View
from glassplat.cli.runs import open_run
from glassplat.evaluate.evaluate import aligned_camera, with_aligned_test_views
from glassplat.files.scene_folder import read_scene, write_scene
from glassplat.files.sidecars import read_cameras, write_colmap
from glassplat.methods.recipe import RECIPES
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model.run_directory import RunDirectory, RunSettings
from glassplat.model.training import Run, Training
from glassplat.render.deferred import Deferred
from glassplat.render.frame import Renderer
from glassplat.render.planar import Planar
from glassplat.render.traced import Traced
from glassplat.scene.camera import Camera
from glassplat.scene.corrections import Exposures, PoseCorrections, moved_camera
from glassplat.scene.scene import Scene
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.corrections import Center, with_neutral_corrections
from glassplat.training.densify import as_discs
from glassplat.training.loop import train
from glassplat.training.options import PoseRefinement
from glassplat.training.stage import TrainState
from tests.render.test_deferred import glossy as deferred_scene
from tests.render.test_planar import CAMERA
from tests.render.test_traced import glossy as traced_scene
from tests.render.tiny_scene import showcase
from tests.training.tiny_capture import tiny_capture, true_scene, write_tiny_capture

TWIST = torch.tensor([0.011, -0.014, 0.008, 0.012, -0.006, 0.004])
REFINED = PoseRefinement(rate=1e-3)


def shaken(dataset: Dataset, numbers: tuple[int, ...] = (2,)) -> Dataset:
    """The capture with some of its training cameras, and its test cameras, moved from their true poses."""
    views = [
        view.with_camera(moved_camera(view.camera, TWIST, dataset.extent)) if number in numbers else view
        for number, view in enumerate(dataset.train)
    ]
    test = [view.with_camera(moved_camera(view.camera, TWIST, dataset.extent)) for view in dataset.test]
    return replace(dataset, train=tuple(views), test=tuple(test))


def misplacement(camera: Camera, other: Camera) -> float:
    return float((camera.cam_from_world - other.cam_from_world).abs().max())


def pixels_off(camera: Camera, other: Camera) -> float:
    """Mean distance on screen of the objects in view; a rotation and a translation may look alike."""
    places = true_scene().primary.means[:14]
    return float((camera.project(places)[0] - other.project(places)[0]).norm(dim=1).mean())


def test_a_twist_is_a_rigid_motion_in_the_cameras_frame() -> None:
    camera = tiny_capture().train[0].camera
    turned = moved_camera(camera, torch.tensor([0.0, 0.0, torch.pi / 2, 0.0, 0.0, 0.5]), 2.0)
    motion = turned.cam_from_world @ torch.linalg.inv(camera.cam_from_world)
    expected = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
    torch.testing.assert_close(motion, expected, atol=1e-6, rtol=0)
    rotation = moved_camera(camera, TWIST, 2.0).cam_from_world[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-6, rtol=0)
    assert misplacement(moved_camera(camera, torch.zeros(6), 2.0), camera) == 0


def discs() -> Scene:
    scene = traced_scene()
    return replace(scene, primary=as_discs(scene.primary), surroundings=as_discs(scene.surroundings))


RENDERED = [
    (Planar(), showcase()),
    (Deferred(), deferred_scene()),
    (Traced(), replace(traced_scene(), environment=deferred_scene().environment)),
    (Traced(), discs()),
]


@pytest.mark.parametrize("twist", [torch.zeros(6).double(), TWIST.double()])
@pytest.mark.parametrize(("renderer", "scene"), RENDERED)
def test_pose_gradients_match_finite_differences_through_the_whole_renderer(
    renderer: Renderer, scene: Scene, twist: Tensor
) -> None:
    weights = torch.randn(28, 40, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)

    def objective(values: Tensor) -> Tensor:
        return (renderer(scene, moved_camera(CAMERA, values, scene.extent)).rgb * weights).sum()

    values = twist.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(objective(values), values)
    with torch.no_grad():
        steps = 1e-6 * torch.eye(6, dtype=torch.float64)
        numerical = torch.stack([(objective(twist + s) - objective(twist - s)) / 2e-6 for s in steps])
    torch.testing.assert_close(gradient, numerical, rtol=1e-3, atol=1e-3 * float(numerical.abs().max()))


def test_a_view_keeps_its_photograph_when_its_camera_moves() -> None:
    read: list[int] = []

    def photo() -> Tensor:
        read.append(1)
        return torch.zeros(4, 5, 3, dtype=torch.uint8)

    view = replace(tiny_capture().train[0], read_photo=photo)
    assert view.photo.shape == view.with_camera(CAMERA).photo.shape == (4, 5, 3)
    assert len(read) == 1 and view.with_camera(CAMERA).camera is CAMERA and view.camera is not CAMERA


def test_a_perturbed_camera_converges_to_its_pose() -> None:
    dataset = shaken(tiny_capture())
    recipe = SplatRecipe(poses=REFINED)
    scene = with_neutral_corrections(recipe, true_scene(), dataset)
    stages = tuple(
        replace(s, renderer=Planar(), rates={"poses.twists": s.rates["poses.twists"]}, actions=(), post_steps=())
        for s in recipe.stages(0)
    )
    state = TrainState(scene, 0)
    for _ in train(stages, dataset, state, 360):
        pass
    refined, before, truth = with_corrected_cameras(dataset, state.scene), dataset.train, tiny_capture().train
    off = pixels_off(before[2].camera, truth[2].camera)
    assert off > 0.4
    assert max(pixels_off(a.camera, b.camera) for a, b in zip(refined.train, truth, strict=True)) < 0.25 * off


def test_motions_are_in_the_axes_of_the_world() -> None:
    first, second = (view.camera for view in tiny_capture().train[:2])
    poses = PoseCorrections(torch.tensor([[0.0, 0, 0.1, 0, 0, 0.5]] * 2), ("a", "b"))
    for camera, name in ((first, "a"), (second, "b")):
        moved = poses.correct(camera, name, 2.0)
        turn = moved.cam_from_world[:3, :3].T @ camera.cam_from_world[:3, :3]
        expected = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.1, 0], [-0.1, 0, 0], [0, 0, 0]]))
        torch.testing.assert_close(turn, expected, atol=1e-5, rtol=0)
        torch.testing.assert_close(moved.center - camera.center, torch.tensor([0.0, 0, -1]), atol=1e-5, rtol=0)


def test_test_cameras_move_as_their_neighbours() -> None:
    view = replace(tiny_capture().test[0], name="10.png")
    twists = torch.tensor([[0.0, 0, 0, 0.1, 0, 0], [0, 0, 0, 0.3, 0, 0], [0, 0, 0, 9, 0, 0]])
    scene = replace(true_scene(), poses=PoseCorrections(twists, ("9.png", "11.png", "12.png")))
    moved = with_corrected_cameras(replace(tiny_capture(), test=(view,)), scene).test[0].camera
    shift = torch.tensor([-0.2 * scene.extent, 0, 0])
    torch.testing.assert_close(moved.center - view.camera.center, shift, atol=1e-5, rtol=0)


def test_test_cameras_are_aligned_with_their_photographs() -> None:
    dataset, truth = shaken(tiny_capture()), tiny_capture()
    aligned = with_aligned_test_views(true_scene(), Planar(), dataset)
    off = pixels_off(dataset.test[0].camera, truth.test[0].camera)
    assert pixels_off(aligned.test[0].camera, truth.test[0].camera) < 0.25 * off
    assert aligned.train is dataset.train


def test_a_test_camera_is_aligned_in_the_colours_of_its_photograph() -> None:
    true, scene = tiny_capture().test[0], true_scene()
    darker = torch.zeros(2, 3, 4)
    darker[:, :, :3] = -0.5 * torch.eye(3)
    exposed = replace(scene, exposures=Exposures(darker, ("0.png", "2.png")))
    view = View.in_memory("1.png", true.camera, photo=(0.5 * true.photo).round().to(torch.uint8))
    start = view.with_camera(moved_camera(view.camera, TWIST, scene.extent))
    found = aligned_camera(exposed, Planar(), start)
    assert pixels_off(found, true.camera) < 0.15 * pixels_off(start.camera, true.camera)


def test_a_camera_without_visible_gaussians_keeps_its_pose() -> None:
    view = tiny_capture().test[0]
    away = view.with_camera(moved_camera(view.camera, torch.tensor([0.0, 0, 0, 0, 0, -50.0]), 2.0))
    assert misplacement(aligned_camera(true_scene(), Planar(), away), away.camera) < 1e-6


@pytest.mark.parametrize("method", RECIPES)
@pytest.mark.parametrize("iterations", [3000, 30_000])
def test_every_stage_of_every_method_refines(method: str, iterations: int) -> None:
    recipe = RECIPES[method](poses=REFINED)
    assert all("poses.twists" in stage.rates for stage in recipe.stages(0, iterations))
    capture = replace(tiny_capture(), measured_points=False)
    assert recipe.initialise(capture).poses.names == tuple(view.name for view in capture.train)
    assert all(stage.post_steps[0] == Center("poses") for stage in recipe.stages(0, iterations))
    off = replace(recipe, poses=PoseRefinement(rate=0.0))
    assert not any("poses.twists" in stage.rates for stage in off.stages(0, iterations))
    assert len(off.initialise(capture).poses) == 0


def corrected_scene() -> Scene:
    return replace(true_scene(), poses=PoseCorrections(TWIST.repeat(2, 1), ("1.png", "a/b.png")))


def test_corrections_are_stored_with_the_scene_and_in_checkpoints(tmp_path: Path) -> None:
    state = TrainState(corrected_scene(), 0)
    write_scene(tmp_path / "scene", state.scene)
    save_checkpoint(tmp_path / "checkpoint.safetensors", state)
    for scene in (read_scene(tmp_path / "scene"), load_checkpoint(tmp_path / "checkpoint.safetensors").scene):
        assert scene.poses.names == state.scene.poses.names
        assert torch.equal(scene.poses.values, state.scene.poses.values)


def test_a_run_leaves_the_refined_cameras(tmp_path: Path) -> None:
    dataset = load_dataset(write_tiny_capture(tmp_path / "capture"))
    directory = RunDirectory(tmp_path / "run")
    settings = RunSettings(str(tmp_path / "capture"), 30)
    recipe = SplatRecipe(poses=PoseRefinement(rate=1e-2))
    state = Run(recipe, settings, directory, dataset, resume=False).run_to_end(lambda message: None)
    refined = with_corrected_cameras(dataset, state.scene)
    recorded = dict(read_cameras(directory.path / "cameras.json"))
    for before, after in zip(dataset.train, refined.train, strict=True):
        assert misplacement(recorded[after.name], after.camera) < 1e-5
        assert misplacement(before.camera, after.camera) > 1e-4
    assert float(state.scene.poses.values.mean(dim=0).abs().max()) < 1e-6


def test_the_model_of_a_training_has_the_cameras_that_its_run_records(tmp_path: Path) -> None:
    dataset = load_dataset(write_tiny_capture(tmp_path / "capture"))
    recipe = SplatRecipe(poses=PoseRefinement(rate=1e-2))
    model = Training(dataset, recipe, iterations=30, device="cpu", output=tmp_path / "run").run()
    recorded = dict(read_cameras(tmp_path / "run" / "cameras.json"))
    assert model.cameras.keys() == recorded.keys()
    for view in (*dataset.train, *dataset.test):
        assert misplacement(recorded[view.name], model.cameras[view.name]) < 1e-5
        assert misplacement(view.camera, model.cameras[view.name]) > 1e-4
    model.save(tmp_path / "saved")
    for view in open_run(tmp_path / "saved", "cpu").dataset.train:
        assert misplacement(recorded[view.name], view.camera) < 1e-5, "saved cameras are corrected already"


def test_a_camera_in_memory_is_moved_by_what_is_on_another_device() -> None:
    elsewhere = moved_camera(CAMERA, torch.zeros(6, device="meta"), 1.0)  # A device that exists on every machine.
    assert elsewhere.cam_from_world.device.type == "meta"


@pytest.mark.parametrize("measured", [True, False])
def test_random_points_are_not_written_as_measured_ones(measured: bool, tmp_path: Path) -> None:
    dataset = replace(tiny_capture(), measured_points=measured)
    RunDirectory(tmp_path).write_trained_cameras(dataset, corrected_scene())
    model = read_model(tmp_path / "sparse/0")
    assert len(model.images) == len(dataset.train) + len(dataset.test)
    assert len(model.points) == (len(dataset.points) if measured else 0)


def test_a_refined_model_is_read_as_colmap(tmp_path: Path) -> None:
    capture = load_dataset(write_tiny_capture(tmp_path / "capture"))
    cameras = [(view.name, view.camera) for view in (*capture.train, *capture.test)]
    points = capture.points
    write_colmap(tmp_path / "capture/sparse/0", cameras, points.positions.numpy(), points.colors.numpy())
    (tmp_path / "capture/transforms.json").unlink()
    (tmp_path / "capture/points3d.ply").unlink()
    again = load_dataset(tmp_path / "capture")
    for view, other in zip(capture.train, again.train, strict=True):
        assert view.name == other.name and misplacement(view.camera, other.camera) < 1e-5
        assert other.camera.fx == pytest.approx(view.camera.fx)
    np.testing.assert_allclose(again.points.positions, points.positions, rtol=1e-5, atol=1e-6)
