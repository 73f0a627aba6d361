"""The ray tracer of panes obeys the laws of optics, and its output is a capture that agrees with its truth."""

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
from glassplat.render.deferred import view_directions
from tools import pane_tracer
from tools.make_pane_scene import Arguments, annotated_views, main, with_glass
from tools.pane_places import passer_by, photographer, screens_place, screens_poses, upright_frame
from tools.pane_things import Ball, Box, Carried, Cylinder, Lamp, Paint, Pane, Place, SecondPane, Silver
from tools.scene_surfaces import INK, solid_noise

ROOM = Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), Paint(1), room=True)
X, Y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
WINDOW = Pane(1, np.zeros(3), Y, X, (1.0, 1.0))


def towards_window(count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Rays from one point, most of which hit the window."""
    generator = np.random.default_rng(0)
    directions = np.concatenate([generator.uniform(-0.9, 0.9, (count, 1)), np.ones((count, 1))], axis=1)
    directions = np.concatenate([directions, generator.uniform(-0.9, 0.9, (count, 1))], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.broadcast_to([0.1, -1.0, 0.2], directions.shape), directions


def test_a_ray_ends_at_the_first_object() -> None:
    place = Place((ROOM, Ball((0.0, 1.0, 0.0), 0.25, Paint(2)), Box((-0.5, 1.5, -0.5), (0.5, 1.7, 0.5), Paint(3))), ())
    origins = np.array([[0.0, -1.0, 0.0], [0.4, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.3, 0.0]])
    distance = place.seen(origins, np.broadcast_to(Y, origins.shape)).distance
    assert distance == pytest.approx([1.75, 2.5, 3.0, 0.2])


def test_glass_reflects_by_fresnels_law_at_both_of_its_surfaces() -> None:
    cosines = np.linspace(0, 1, 50)[1:]
    expected = two_surfaces(torch.tensor(WINDOW.base_reflectance), torch.from_numpy(cosines))
    assert WINDOW.base_reflectance == pytest.approx(2 * 0.04 / 1.04)
    np.testing.assert_allclose([pane_tracer.reflectance(c, 1.5) for c in cosines], expected, rtol=1e-6)
    assert pane_tracer.reflectance(0.3, 0.0) == 1 == replace(WINDOW, refraction=None).base_reflectance


def test_one_pane_adds_its_reflection_to_what_is_behind_it() -> None:
    seen = Place((ROOM, Ball((0.0, 1.0, 0.0), 0.25, Paint(2))), (WINDOW,)).seen(*towards_window())
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


def test_double_glazing_mirrors_twice_as_much() -> None:
    rays = towards_window()
    one, two = (Place((ROOM,), (replace(WINDOW, second=s),)).seen(*rays) for s in (None, SecondPane(0.0, 0.0)))
    np.testing.assert_allclose(two.strength, one.strength + one.strength * (1 - one.strength) ** 2)
    np.testing.assert_allclose(two.reflection, one.reflection, atol=1e-9)
    once = WINDOW.base_reflectance
    assert replace(WINDOW, second=SecondPane(0.0, 0.0)).base_reflectance == pytest.approx(once * (1 + (1 - once) ** 2))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_second_pane_reflects_from_twice_the_gap_farther(side: float) -> None:
    gap, room = 0.1, Place((ROOM,), ())
    pane = replace(WINDOW, second=SecondPane(gap, 0.0))
    direction = np.array([[0.3, side, 0.2]]) / np.linalg.norm([0.3, side, 0.2])
    seen = Place((ROOM,), (pane,)).seen(-direction, direction, reflections=1)
    once = pane_tracer.reflectance(abs(direction[0, 1]), 1.5)
    passed = once * (1 - once) ** 2
    # The normal points along y, so that the second pane lies at smaller y: nearer, when seen from there.
    first, second = (room.seen(y / direction[:, 1:2] * direction, direction * [1, -1, 1]).radiance for y in (0.0, -gap))
    shares = (passed, once) if side > 0 else (once, passed)
    np.testing.assert_allclose(seen.strength, once + passed)
    assert np.abs(first - second).max() > 1e-3
    np.testing.assert_allclose(seen.reflection * seen.strength, shares[0] * first + shares[1] * second)


def test_tilted_double_glazing_mirrors_another_direction_by_twice_the_tilt() -> None:
    tilt = np.radians(5.0)
    pane = replace(WINDOW, second=SecondPane(0.0, tilt))
    seen = Place((ROOM,), (pane,)).seen(np.array([[0.0, -1.0, 0.0]]), Y[None])
    room, start = Place((ROOM,), ()), np.zeros((1, 3))
    up = pane.bitangent
    turned = [np.cos(2 * tilt) * -Y + sign * np.sin(2 * tilt) * up for sign in (-1, 1)]
    straight, *tilted = (room.seen(start, ray[None]).radiance for ray in (-Y, *turned))
    once = WINDOW.base_reflectance
    back = seen.reflection * seen.strength - once * (1 - once) ** 2 * straight
    assert min(np.abs(back - once * radiance).max() for radiance in tilted) < 1e-9


def test_only_glass_gets_a_second_pane() -> None:
    place = with_glass(screens_place(), Arguments(Path(), second_pane=0.1))
    assert [pane.second is None for pane in place.panes] == [False, False, True]


def test_no_light_is_lost_between_a_pane_and_a_room_that_shines_evenly() -> None:
    bright = Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), Paint(glow=(0.7, 0.5, 0.3)), room=True)
    second = replace(WINDOW, label=2, center=np.array([0.0, 0.5, 0.0]), refraction=1.8)
    seen = Place((bright,), (replace(WINDOW, second=None), second)).seen(*towards_window())
    assert (seen.label == 1).sum() > 50
    np.testing.assert_allclose(seen.radiance, np.broadcast_to([0.7, 0.5, 0.3], seen.radiance.shape))


def test_paint_is_the_solid_noise_of_the_other_scenes() -> None:
    place = Place((Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), Paint(5, pattern="plain"), room=True),), ())
    origins, directions = towards_window()
    seen = place.seen(origins, directions)
    points = origins + seen.distance[:, None] * directions
    grain = 0.75 + 0.5 * solid_noise(points, frequency=6.0, seed=7, waves=16)
    ink = np.random.default_rng(5).permutation(INK)[0]
    np.testing.assert_allclose(seen.radiance, np.clip(grain[:, None] * ink, 0.01, 1), atol=1e-9)


def test_a_lamp_lights_what_faces_it_half_as_much_at_its_reach() -> None:
    plain = Paint(5, pattern="plain")
    room = Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), plain, room=True)
    ray = np.array([[0.0, -1.0, 0.0]]), Y[None]
    (dark,) = Place((room,), ()).seen(*ray).radiance
    # The ray ends at y = 2: the lamp is first in front of that, then behind it.
    lit = [
        Place((room,), (), (Lamp((0.0, y, 0.0), reach=0.5, power=2.0),), ambient=0.0).seen(*ray).radiance[0] / dark
        for y in (1.5, 2.5)
    ]
    np.testing.assert_allclose(lit, [[1.0] * 3, [0.0] * 3], atol=1e-9)


def test_rays_hit_a_cylinder_at_its_side_and_its_cap() -> None:
    place = Place((ROOM, Cylinder((-0.5, -0.5, -1.0), (0.5, 0.5, 0.5), Paint(3))), ())
    origins = np.array([[0.0, -1.5, 0.0], [0.3, -1.5, 0.0], [0.3, 0.2, 1.5], [0.45, 0.45, 1.5]])
    directions = np.array([[0.0, 1, 0], [0, 1, 0], [0, 0, -1], [0, 0, -1]])
    assert place.seen(origins, directions).distance == pytest.approx([1.0, 1.1, 1.0, 3.5])


def test_a_mirror_shows_what_a_mirrored_camera_sees() -> None:
    origins, directions = towards_window()
    seen = Place((ROOM,), (replace(WINDOW, refraction=None),)).seen(origins, directions)
    image = Place((ROOM,), ()).seen(origins * [1, -1, 1], directions * [1, -1, 1]).radiance
    hit = seen.label == 1
    np.testing.assert_allclose(seen.radiance[hit], image[hit], atol=1e-9)


def test_a_pane_behind_a_pane_returns_light_through_the_first() -> None:
    second = replace(WINDOW, label=2, center=np.array([0.0, 0.5, 0.0]))
    origins, directions = np.array([[0.0, -1.0, 0.0]]), Y[None]
    behind, front = (
        Place((ROOM,), ()).seen(origins + start * Y, sign * directions).radiance
        for start, sign in ((0.0, 1), (0.0, -1))
    )
    share = WINDOW.base_reflectance
    # At normal incidence the room is the same for both panes; light may be reflected between them once more.
    once = (1 - share) ** 2 * behind + (share + (1 - share) ** 2 * share) * front
    more = (1 - share) ** 2 * share**2 * (behind + share * front)
    radiance = Place((ROOM,), (WINDOW, second)).seen(origins, directions, reflections=3).radiance
    np.testing.assert_allclose(radiance, once + more, atol=share**4)
    swapped = Place((ROOM,), (second, WINDOW)).seen(origins, directions, reflections=3).radiance
    np.testing.assert_allclose(radiance, swapped)


def test_the_reflection_of_a_pane_behind_a_pane_is_part_of_the_transmission() -> None:
    second = replace(WINDOW, label=2, center=np.array([0.0, 0.5, 0.0]))
    origins, directions = towards_window()
    both = Place((ROOM,), (WINDOW, second)).seen(origins, directions)
    alone = Place((ROOM,), (second,)).seen(origins, directions, reflections=1)
    through = (both.label == 1) & (alone.label == 2)
    share = both.strength[:, None]
    assert through.mean() > 0.2
    np.testing.assert_allclose(both.radiance, (1 - share) * both.transmission + share * both.reflection)
    # Except for multiple reflections between the panes.
    np.testing.assert_allclose(both.transmission[through], alone.radiance[through], atol=0.02)
    behind = Place((ROOM,), ()).seen(origins, directions).radiance
    assert float(np.abs(both.transmission - behind)[through].mean()) > 0.02


def test_the_capture_fits_its_truth(tmp_path: Path) -> None:
    main(Arguments(tmp_path / "scene", width=40, views=16, masks=6, points=200))
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
        # Objects may occlude a pane, but every labelled pixel lies on one.
        assert (hits[masked] == view.pane_labels[masked]).float().mean() > 0.98
        checked += int(masked.sum())
    assert checked > 200
    view = dataset.test[0]
    layers = truth.view(view.name, view.camera.width, view.camera.height)
    assert layers is not None
    assert (view.photo[layers.strength == 0] == layers.transmission[layers.strength == 0]).all()


def test_masks_show_every_pane_several_times() -> None:
    place, poses = screens_place(), screens_poses(48, seed=0)
    chosen = annotated_views(place, poses, 8)
    assert len(chosen) == 8 and all(number % 8 for number in chosen)
    labels = np.stack([place.view(poses[number], 16, 12).label for number in sorted(chosen)])
    for pane in place.panes:
        assert ((labels == pane.label).mean(axis=(1, 2, 3)) > 0.02).sum() >= 3


STANDING = np.array([[1.0, 0, 0, 0.1], [0, 0, 1, -1.0], [0, -1, 0, 1.2], [0, 0, 0, 1]])
"""A camera in front of the window that looks along +y, 1.2 above the floor."""


def test_the_body_stands_on_the_floor_behind_the_camera_however_that_is_tilted() -> None:
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("x", -30, degrees=True).as_matrix()
    for pose in (STANDING, STANDING @ tilt):
        np.testing.assert_allclose(upright_frame(pose), STANDING, atol=1e-12)
        # Rays downwards: onto the shoulders, from inside the torso onto the legs, and past both onto the floor.
        above = np.array([[0.2, -1.2, 1.1], [0.2, -1.2, 0.45], [0.6, -1.2, 1.1]])
        place = Place((Box((-3.0, -3.0, 0.0), (3.0, 3.0, 3.0), Paint(1), room=True), *photographer(pose)), ())
        distances = place.seen(above, np.broadcast_to([0.0, 0.0, -1.0], above.shape)).distance
        np.testing.assert_allclose(distances, [1.1 - (1.2 - 0.18), 0.45 - (1.2 - 0.8), 1.1])


def test_only_mirrored_rays_hit_the_photographer() -> None:
    room = Box((-2.0, -2.0, 0.0), (2.0, 2.0, 2.5), Paint(1), room=True)
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
    # The reflection in the window equals the view of the body from the mirrored position behind the window.
    body_in_room = Place((room, *somebody), ())
    image = body_in_room.seen(origins[hit] * [1, -1, 1], directions[hit] * [1, -1, 1]).radiance
    np.testing.assert_allclose(seen.reflection[hit], image, atol=1e-9)


def test_carried_objects_keep_their_texture() -> None:
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_euler("xyz", [20, 50, -10], degrees=True).as_matrix(), [0.3, -0.2, 0.1]
    ball = Ball((0.0, 1.0, 0.0), 0.25, Paint(2))
    rays = towards_window()
    before = Place((ROOM, ball), ()).seen(*rays).radiance
    moved = Place((Carried(ROOM, turn), Carried(ball, turn)), ())
    after = moved.seen(rays[0] @ turn[:3, :3].T + turn[:3, 3], rays[1] @ turn[:3, :3].T).radiance
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_ground_truth_layers_exclude_the_photographer(tmp_path: Path) -> None:
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


def test_passers_by_are_masked_and_absent_from_test_views(tmp_path: Path) -> None:
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


def test_passers_by_avoid_walls_and_the_camera() -> None:
    room, camera = Box((-2.0, -2.0, 0.0), (2.0, 2.0, 2.5), Paint(1), room=True), np.array([0.5, 0.2, 1.4])
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


def test_the_silver_object_reflects_the_room_by_its_normals() -> None:
    place = Place((ROOM,), (), silver=(SILVER,))
    origins, directions = towards_window()
    seen = place.seen(origins, directions)
    hit = seen.normal.any(axis=1)
    assert 0.1 < hit.mean() < 0.9
    points = origins + seen.distance[:, None] * directions
    inside = ((points - SILVER.center) / SILVER.radii)[hit]
    np.testing.assert_allclose((inside**2).sum(axis=1), 1)
    # The normal bisects the angle between both rays, which lie in one plane with it.
    normals = seen.normal[hit]
    onwards = directions[hit] - 2 * (directions[hit] * normals).sum(axis=1, keepdims=True) * normals
    room = Place((ROOM,), ())
    np.testing.assert_allclose(seen.radiance[hit], room.seen(points[hit], onwards).radiance, atol=1e-9)
    np.testing.assert_array_equal(seen.radiance[~hit], room.seen(origins, directions).radiance[~hit])


def test_normals_of_the_silver_object_match_its_depths() -> None:
    eye = np.array([0.1, -1.0, 0.2])
    ray = np.array([0.02, 1.0, -0.1])
    steps = ray + 1e-5 * np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]])
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    seen = Place((ROOM,), (), silver=(SILVER,)).seen(np.broadcast_to(eye, steps.shape), steps)
    points, normal = eye + seen.distance[:, None] * steps, seen.normal[0]
    across = np.cross(points[1] - points[0], points[2] - points[0])
    across /= np.linalg.norm(across)
    assert normal @ ray < 0
    np.testing.assert_allclose(abs(across @ normal), 1, atol=1e-6)


def test_a_mirror_shows_silver_and_what_that_mirrors() -> None:
    origins, directions = towards_window()
    before = Silver((1.0, -0.6, 0.3), (0.3, 0.2, 0.4))
    mirror = replace(WINDOW, refraction=None)
    seen = Place((ROOM,), (mirror,), silver=(before,)).seen(origins, directions)
    hit = (seen.label == 1) & ~seen.normal.any(axis=1)
    # The mirrored rays see the same scene, except for the mirror, which shows the silver.
    eyes, rays = (vectors[hit] * [1, -1, 1] for vectors in (origins, directions))
    starts = eyes - (eyes[:, 1:2] / rays[:, 1:2]) * rays
    image = Place((ROOM,), (mirror,), silver=(before,)).seen(starts, rays, reflections=2)
    assert image.normal.any(axis=1).mean() > 0.05
    np.testing.assert_allclose(seen.radiance[hit], image.radiance, atol=1e-9)


def test_the_case_ships_the_surface_of_its_silver(tmp_path: Path) -> None:
    main(Arguments(tmp_path / "case", width=28, views=9, masks=2, points=200, case=True))
    dataset = load_dataset(tmp_path / "case")
    assert dataset.planes is not None and dataset.planes.labels == (1, 2) and dataset.planes.mirrors == (2,)
    surface = true_surface(dataset.test[0])
    assert surface is not None and surface.normals is not None and surface.strength is not None
    silver = surface.covered
    assert 0.02 < float(silver.float().mean()) < 0.5
    # It faces the camera that sees it, and only its pixels have strengths above one half.
    away = (surface.normals * torch.nn.functional.normalize(view_directions(dataset.test[0].camera), dim=-1)).sum(-1)
    assert float(away[silver].max()) < 0.1
    assert float(surface.strength[silver].min()) >= 0.5
    assert float(surface.strength[~silver].max()) <= 0.5
