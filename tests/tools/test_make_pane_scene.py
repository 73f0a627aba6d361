"""The ray tracer of panes keeps to the laws of optics, and what it writes is a capture that fits its truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from glassplat.captures.dataset import load_dataset
from glassplat.evaluate.truth import load_truth, true_surface
from glassplat.files.images import read_image
from glassplat.kernels.panes.reference import pane_hits, two_surfaces
from glassplat.kernels.records import Panes
from tools.make_pane_scene import Arguments, main, make_place, with_glass
from tools.pane_tracer import Ball, Box, Carried, Place, Silver
from tools.photographer_body import passer_by, photographer, upright_frame
from tools.tracer_panes import Pane, SecondPane, Waves

ROOM = Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), seed=1, room=True)
X, Y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
WINDOW = Pane(1, np.zeros(3), Y, X, (1.0, 1.0))


def towards_window(count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Rays from one point, most of which meet the window."""
    generator = np.random.default_rng(0)
    directions = np.concatenate([generator.uniform(-0.9, 0.9, (count, 1)), np.ones((count, 1))], axis=1)
    directions = np.concatenate([directions, generator.uniform(-0.9, 0.9, (count, 1))], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.broadcast_to([0.1, -1.0, 0.2], directions.shape), directions


def test_a_ray_ends_at_the_first_thing() -> None:
    place = Place((ROOM, Ball((0.0, 1.0, 0.0), 0.25, seed=2), Box((-0.5, 1.5, -0.5), (0.5, 1.7, 0.5), seed=3)), ())
    origins = np.array([[0.0, -1.0, 0.0], [0.4, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.3, 0.0]])
    _, distance = place.without_panes(origins, np.broadcast_to(Y, origins.shape))
    assert distance == pytest.approx([1.75, 2.5, 3.0, 0.2])


def test_glass_reflects_by_fresnels_law_at_both_of_its_surfaces() -> None:
    cosines = np.linspace(0, 1, 50)[1:]
    expected = two_surfaces(torch.tensor(WINDOW.base_reflectance), torch.from_numpy(cosines))
    assert WINDOW.base_reflectance == pytest.approx(2 * 0.04 / 1.04)
    np.testing.assert_allclose(WINDOW.reflectances(cosines), expected, rtol=1e-6)
    assert (replace(WINDOW, refraction=None).reflectances(cosines) == 1).all()


def test_one_pane_adds_its_reflection_to_what_is_behind_it() -> None:
    seen = Place((ROOM, Ball((0.0, 1.0, 0.0), 0.25, seed=2)), (WINDOW,)).seen(*towards_window())
    share = seen.strength[:, None]
    hit = seen.label == 1
    assert 0.3 < hit.mean() < 1
    np.testing.assert_allclose(seen.radiance, (1 - share) * seen.transmission + share * seen.reflection)
    assert (seen.strength[~hit] == 0).all()
    assert (np.abs(seen.reflection - seen.transmission)[hit] > 0.05).any(axis=1).mean() > 0.3


def test_tinted_glass_dims_what_comes_through_and_not_what_comes_back() -> None:
    plain, tint = Place((ROOM,), (WINDOW,)).seen(*towards_window()), (0.5, 0.8, 0.6)
    seen = Place((ROOM,), (replace(WINDOW, tint=tint),)).seen(*towards_window())
    hit, share = plain.label == 1, plain.strength[:, None]
    np.testing.assert_allclose(seen.transmission[hit], plain.transmission[hit] * tint)
    np.testing.assert_array_equal(seen.transmission[~hit], plain.transmission[~hit])
    np.testing.assert_array_equal(seen.reflection, plain.reflection)
    np.testing.assert_allclose(seen.radiance, (1 - share) * seen.transmission + share * seen.reflection)


def test_mirrors_have_no_tint(tmp_path: Path) -> None:
    main(Arguments(tmp_path / "scene", width=16, views=8, masks=1, points=10, tint=(0.5, 0.8, 0.6)))
    planes = json.loads((tmp_path / "scene/gt/planes.json").read_text())
    assert [plane["tint"] for plane in planes] == [[0.5, 0.8, 0.6], [0.5, 0.8, 0.6], [1.0, 1.0, 1.0]]


def test_waves_turn_normals_by_as_much_as_they_are_told_to() -> None:
    places = np.random.default_rng(3).uniform(-3, 3, (20000, 2))
    points = places @ np.stack([X, [0.0, 0.0, 1.0]])
    normals = replace(WINDOW, waves=Waves(np.radians(0.5))).normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    turned = np.degrees(np.arccos(np.clip(normals @ Y, -1, 1)))
    assert np.sqrt((turned**2).mean()) == pytest.approx(0.5, rel=0.05)


def test_waves_are_smooth() -> None:
    waves, places = Waves(0.01, length=0.6), np.random.default_rng(3).uniform(-1, 1, (100, 2))
    step = 1e-4
    shifted = np.abs(waves.slopes(places + np.array([step, 0])) - waves.slopes(places)).max()
    assert 0 < shifted < 3 * 0.01 * 2 * np.pi / 0.6 * step


def test_waves_move_what_is_mirrored_and_leave_what_comes_through() -> None:
    rays = towards_window()
    even, waved = (Place((ROOM,), (replace(WINDOW, waves=waves),)).seen(*rays) for waves in (None, Waves(0.02)))
    np.testing.assert_array_equal(waved.transmission, even.transmission)
    np.testing.assert_array_equal(waved.strength, even.strength)
    assert np.abs(waved.reflection - even.reflection).max() > 0.01


def test_double_glazing_mirrors_twice_as_much() -> None:
    rays = towards_window()
    one, two = (Place((ROOM,), (replace(WINDOW, second=s),)).seen(*rays) for s in (None, SecondPane(0.0, 0.0)))
    np.testing.assert_allclose(two.strength, one.strength + one.strength * (1 - one.strength) ** 2)
    np.testing.assert_allclose(two.reflection, one.reflection, atol=1e-9)
    once = WINDOW.base_reflectance
    assert replace(WINDOW, second=SecondPane(0.0, 0.0)).base_reflectance == pytest.approx(once * (1 + (1 - once) ** 2))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_second_pane_mirrors_what_lies_twice_the_gap_farther(side: float) -> None:
    gap, origins = 0.1, np.array([[0.0, -side, 0.0]])
    near, far = replace(WINDOW, second=SecondPane(gap, 0.0)).meetings(origins, side * Y[None], np.array([1.0]))
    np.testing.assert_allclose(near.points, [[0, 0, 0]], atol=1e-12)
    # The normal points along y, so that the second pane lies at smaller y: nearer, for who stands there.
    np.testing.assert_allclose(far.points, [[0, -gap, 0]], atol=1e-12)
    assert (near.share < far.share).item() == (side > 0)


def test_tilted_double_glazing_mirrors_two_directions() -> None:
    pane = replace(WINDOW, second=SecondPane(0.0, np.radians(0.25)))
    near, far = pane.meetings(np.array([[0.0, -1.0, 0.0]]), Y[None], np.array([1.0]))
    between = np.degrees(np.arccos((near.mirrored * far.mirrored).sum()))
    assert between == pytest.approx(0.5, abs=1e-3)


def test_only_glass_gets_waves_and_a_second_pane() -> None:
    place = with_glass(make_place(), Arguments(Path(), waves=0.2, second_pane=0.1))
    assert [(p.waves is None, p.second is None) for p in place.panes] == [(False, False), (False, False), (True, True)]


def test_a_mirror_shows_what_a_mirrored_camera_sees() -> None:
    origins, directions = towards_window()
    seen = Place((ROOM,), (replace(WINDOW, refraction=None),)).seen(origins, directions)
    image, _ = Place((ROOM,), ()).without_panes(origins * [1, -1, 1], directions * [1, -1, 1])
    hit = seen.label == 1
    np.testing.assert_allclose(seen.radiance[hit], image[hit], atol=1e-9)


def test_a_pane_behind_a_pane_returns_light_through_the_first() -> None:
    second = replace(WINDOW, label=2, center=np.array([0.0, 0.5, 0.0]))
    origins, directions = np.array([[0.0, -1.0, 0.0]]), Y[None]
    behind, front = (
        Place((ROOM,), ()).without_panes(origins + start * Y, sign * directions)[0]
        for start, sign in ((0.0, 1), (0.0, -1))
    )
    share = WINDOW.base_reflectance
    # Seen head-on the room is the same for both panes; light may be thrown to and fro between them once more.
    once = (1 - share) ** 2 * behind + (share + (1 - share) ** 2 * share) * front
    more = (1 - share) ** 2 * share**2 * (behind + share * front)
    radiance = Place((ROOM,), (WINDOW, second)).radiance(origins, directions, reflections=3)
    np.testing.assert_allclose(radiance, once + more, atol=share**4)
    swapped = Place((ROOM,), (second, WINDOW)).radiance(origins, directions, reflections=3)
    np.testing.assert_allclose(radiance, swapped)


def test_what_a_pane_behind_a_pane_returns_is_part_of_the_transmission() -> None:
    second = replace(WINDOW, label=2, center=np.array([0.0, 0.5, 0.0]))
    origins, directions = towards_window()
    both = Place((ROOM,), (WINDOW, second)).seen(origins, directions)
    alone = Place((ROOM,), (second,)).seen(origins, directions, reflections=1)
    through = (both.label == 1) & (alone.label == 2)
    share = both.strength[:, None]
    assert through.mean() > 0.2
    np.testing.assert_allclose(both.radiance, (1 - share) * both.transmission + share * both.reflection)
    # But for light thrown to and fro between the panes.
    np.testing.assert_allclose(both.transmission[through], alone.radiance[through], atol=0.02)
    behind, _ = Place((ROOM,), ()).without_panes(origins, directions)
    assert float(np.abs(both.transmission - behind)[through].mean()) > 0.02


def test_the_capture_fits_its_truth(tmp_path: Path) -> None:
    main(Arguments(tmp_path / "scene", width=40, views=16, masks=2, points=200))
    dataset = load_dataset(tmp_path / "scene")
    truth = load_truth(dataset.truth)
    assert truth is not None
    assert dataset.pane_labels == (1, 2, 3)
    assert [plane.mirror for plane in truth.planes] == [False, False, True]
    checked = 0
    for view in dataset.train:
        if view.pane_labels is None:
            continue
        pose, camera = view.camera.cam_from_world.double(), view.camera
        vectors = {
            name: torch.tensor([getattr(plane, name) for plane in truth.planes], dtype=torch.float64)
            for name in ("center", "normal", "half_u", "half_v")
        }
        turned = {name: value @ pose[:3, :3].T for name, value in vectors.items()}
        halves = torch.stack([turned["half_u"], turned["half_v"]], dim=1)
        sizes = halves.norm(dim=-1)
        panes = Panes(turned["center"] + pose[:3, 3], turned["normal"], halves / sizes[..., None], sizes)
        hits = pane_hits(panes, camera.intrinsics.double(), camera.width, camera.height).pane + 1
        masked = view.pane_labels > 0
        # Things may stand before a pane; nowhere else is there one.
        assert (hits[masked] == view.pane_labels[masked]).float().mean() > 0.98
        checked += int(masked.sum())
    assert checked > 200
    view = dataset.test[0]
    layers = truth.view(view.name, view.camera.width, view.camera.height)
    assert layers is not None
    assert (view.photo[layers.strength == 0] == layers.transmission[layers.strength == 0]).all()


STANDING = np.array([[1.0, 0, 0, 0.1], [0, 0, 1, -1.0], [0, -1, 0, 1.2], [0, 0, 0, 1]])
"""A camera before the window that looks along +y, 1.2 above the floor."""


def test_the_body_stands_on_the_floor_behind_the_camera_however_that_is_tilted() -> None:
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("x", -30, degrees=True).as_matrix()
    for pose in (STANDING, STANDING @ tilt):
        np.testing.assert_allclose(upright_frame(pose), STANDING, atol=1e-12)
        # Downwards: onto the shoulders, from within the torso onto the legs, and past both.
        above = np.array([[0.2, -1.2, 1.1], [0.2, -1.2, 0.45], [0.6, -1.2, 1.1]])
        below = np.broadcast_to([0.0, 0.0, -1.0], above.shape)
        distances = np.min([part.distances(above, below) for part in photographer(pose)], axis=0)
        np.testing.assert_allclose(distances, [1.1 - (1.2 - 0.18), 0.45 - (1.2 - 0.8), np.inf])


def test_only_mirrored_rays_meet_the_photographer() -> None:
    room = Box((-2.0, -2.0, 0.0), (2.0, 2.0, 2.5), seed=1, room=True)
    window = replace(WINDOW, center=np.array([0.0, 0.0, 1.2]))
    somebody = photographer(STANDING)
    origins, directions = towards_window()
    origins = np.broadcast_to(STANDING[:3, 3], origins.shape)
    alone, peopled = Place((room,), (window,)), Place((room,), (window,), photographer=somebody)
    nobody, seen = alone.seen(origins, directions), peopled.seen(origins, directions)
    hit = nobody.label == 1
    np.testing.assert_array_equal(seen.transmission, nobody.transmission)
    np.testing.assert_array_equal(seen.radiance[~hit], nobody.radiance[~hit])
    differs = (np.abs(seen.reflection - nobody.reflection) > 1e-9).any(axis=1)
    assert differs.mean() > 0.01
    # What the window mirrors is what somebody sees who looks at the body from behind the window.
    body_in_room = Place((room, *somebody), ())
    image, _ = body_in_room.without_panes(origins[hit] * [1, -1, 1], directions[hit] * [1, -1, 1])
    np.testing.assert_allclose(seen.reflection[hit], image, atol=1e-9)


def test_what_is_carried_keeps_its_texture() -> None:
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_euler("xyz", [20, 50, -10], degrees=True).as_matrix(), [0.3, -0.2, 0.1]
    ball = Ball((0.0, 1.0, 0.0), 0.25, seed=2)
    rays = towards_window()
    before, _ = Place((ROOM, ball), ()).without_panes(*rays)
    moved = Place((Carried(ROOM, turn), Carried(ball, turn)), ())
    after, _ = moved.without_panes(rays[0] @ turn[:3, :3].T + turn[:3, 3], rays[1] @ turn[:3, :3].T)
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_layers_are_those_without_a_photographer_and_beside_them_with_one(tmp_path: Path) -> None:
    arguments = Arguments(tmp_path / "peopled", width=24, views=9, masks=1, points=10, window=True, photographer=True)
    main(arguments)
    main(replace(arguments, output=tmp_path / "empty", photographer=False))
    peopled, empty = tmp_path / "peopled", tmp_path / "empty"
    for part in ("gt/refl", "gt/trans", "gt/strength"):
        for path in sorted((empty / part).iterdir()):
            assert path.read_bytes() == (peopled / part / path.name).read_bytes()
    names = [path.name for path in sorted((empty / "gt/refl").iterdir())]
    assert any(
        (peopled / "gt/with_photographer/refl" / name).read_bytes() != (peopled / "gt/refl" / name).read_bytes()
        for name in names
    )
    assert (peopled / "images/0000.png").read_bytes() != (empty / "images/0000.png").read_bytes()


def test_those_who_walk_by_are_in_the_masks_that_tell_of_them_and_in_no_test_view(tmp_path: Path) -> None:
    arguments = Arguments(tmp_path / "passed", width=32, views=10, masks=1, points=10, window=True, passers_by=1.0)
    main(arguments)
    main(replace(arguments, output=tmp_path / "empty", passers_by=0.0))
    shown = 0
    for path in sorted((tmp_path / "empty/images").iterdir()):
        alone, passed = read_image(path), read_image(tmp_path / "passed/images" / path.name)
        mask = tmp_path / "passed/gt/passers_by" / path.name
        if path.name in ("0000.png", "0008.png"):
            assert not mask.exists() and (alone == passed).all()
            continue
        there = read_image(mask)[..., 0] > 0
        assert np.abs(alone.astype(int) - passed)[~there].max(initial=0) <= 2
        shown += int(there.any())
    assert shown >= 2


def test_nobody_walks_through_walls_or_the_camera() -> None:
    room, camera = Box((-2.0, -2.0, 0.0), (2.0, 2.0, 2.5), seed=1, room=True), np.array([0.5, 0.2, 1.4])
    generator = np.random.default_rng(0)
    places = []
    for _ in range(30):
        head = passer_by(room, camera, generator)[1]
        assert isinstance(head, Carried)
        places.append(head.world_from_thing[:3, 3])
    assert np.abs(np.array(places)[:, :2]).max() <= 1.6 and np.array(places)[:, 2].max() < 1.8
    assert np.linalg.norm(np.array(places)[:, :2] - camera[:2], axis=1).min() >= 0.7
    assert np.ptp(np.array(places), axis=0).min() > 0.15


def test_a_scene_is_not_overwritten(tmp_path: Path) -> None:
    with pytest.raises(FileExistsError, match="expected a new folder"):
        main(Arguments(tmp_path))


SILVER = Silver((0.0, 1.0, 0.0), (0.9, 0.5, 0.8))


def test_silver_mirrors_the_room_as_its_normals_say() -> None:
    place = Place((ROOM,), (), silver=(SILVER,))
    origins, directions = towards_window()
    normals = place.silver_normals(origins, directions)
    hit = normals.any(axis=1)
    assert 0.1 < hit.mean() < 0.9
    radiance, distance = place.without_panes(origins, directions)
    points = origins + distance[:, None] * directions
    inside = ((points - SILVER.center) / SILVER.radii)[hit]
    np.testing.assert_allclose((inside**2).sum(axis=1), 1)
    # The normal halves the angle between both ways, which are in one plane with it.
    onwards = directions[hit] - 2 * (directions[hit] * normals[hit]).sum(axis=1, keepdims=True) * normals[hit]
    seen, _ = Place((ROOM,), ()).without_panes(points[hit], onwards)
    np.testing.assert_allclose(radiance[hit], seen)
    room, _ = Place((ROOM,), ()).without_panes(origins, directions)
    np.testing.assert_array_equal(radiance[~hit], room[~hit])


def test_normals_of_silver_are_those_of_its_depths() -> None:
    eye = np.array([0.1, -1.0, 0.2])
    ray = np.array([0.02, 1.0, -0.1])
    steps = ray + 1e-5 * np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]])
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    points = eye + SILVER.distances(np.broadcast_to(eye, steps.shape), steps)[:, None] * steps
    across = np.cross(points[1] - points[0], points[2] - points[0])
    across /= np.linalg.norm(across)
    (normal,) = SILVER.normals(points[:1])
    assert normal @ ray < 0
    np.testing.assert_allclose(abs(across @ normal), 1, atol=1e-6)


def test_a_mirror_shows_silver_and_what_that_mirrors() -> None:
    origins, directions = towards_window()
    before = Silver((1.0, -0.6, 0.3), (0.3, 0.2, 0.4))
    mirror = replace(WINDOW, refraction=None)
    seen = Place((ROOM,), (mirror,), silver=(before,)).seen(origins, directions)
    hit = (seen.label == 1) & ~seen.normal.any(axis=1)
    # The place on the other side of the mirror's plane is the same but for the mirror, in which the silver is seen.
    image, _ = Place((ROOM,), (mirror,), silver=(before,)).without_panes(
        origins[hit] * [1, -1, 1], directions[hit] * [1, -1, 1], reflections=2
    )
    shows = Place((ROOM,), (), silver=(before,)).silver_normals(origins[hit] * [1, -1, 1], directions[hit] * [1, -1, 1])
    assert shows.any(axis=1).mean() > 0.05
    np.testing.assert_allclose(seen.radiance[hit], image, atol=1e-9)


def test_the_case_ships_the_surface_of_its_silver(tmp_path: Path) -> None:
    main(Arguments(tmp_path / "case", width=28, views=9, masks=2, points=200, case=True))
    dataset = load_dataset(tmp_path / "case")
    assert dataset.planes is not None and dataset.planes.labels == (1, 2) and dataset.planes.mirrors == (2,)
    surface = true_surface(dataset.test[0])
    assert surface is not None and surface.normals is not None and surface.strength is not None
    silver = surface.covered
    assert 0.02 < float(silver.float().mean()) < 0.5
    # It faces the camera that sees it, and reflects where it is.
    away = (surface.normals * dataset.test[0].camera.ray_directions()).sum(-1)
    assert float(away[silver].max()) < 0.1
    assert float(surface.strength[silver].min()) >= 0.5
    assert float(surface.strength[~silver].max()) <= 0.5
