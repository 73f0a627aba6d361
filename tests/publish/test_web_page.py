"""The page shows the same images as the renderer, requests nothing, and its buttons work."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import quote, unquote

import pytest
import torch
from PIL import Image

from glassplat.evaluate.metrics import psnr
from glassplat.publish import web_page
from glassplat.publish.web_page import (
    SCRIPTS,
    SHADERS,
    Sharing,
    cube_bytes,
    fill_template,
    fits_page,
    page_text,
    preview_tags,
    read_asset,
    select_for_page,
    write_page,
    write_preview,
)
from glassplat.render.deferred import Deferred
from glassplat.render.frame import Renderer
from glassplat.render.layers import layer_image
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.render.traced import Traced
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Environment, Scene, as_mirrors, scale_scene, without_glass
from tests.browser_needed import needs_browser
from tests.render.test_deferred import glossy as glossy_scene
from tests.render.tiny_scene import camera_at, concatenated, in_single_precision
from tests.training.tiny_capture import tiny_capture, true_scene
from tools.browser import Browser
from tools.page_likeness import picture, pixels_of

pytestmark = pytest.mark.usefixtures("one_chromium")

CAMERAS = [(view.name, view.camera) for view in tiny_capture().train]
LARGEST_SCRIPT = 72 * 1024


def likeness(browser: Browser, scene: Scene, renderer: Planar | Splat, camera: Camera, layer: str = "rgb") -> float:
    """PSNR of the page's image against the renderer's, in dB."""
    with torch.no_grad():
        frame = renderer(scene, camera)
    truth = layer_image(frame, layer)
    truth = truth if truth.dim() == 3 else truth[..., None].expand(-1, -1, 3)
    return psnr(picture(browser, camera, layer), truth)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    path = tmp_path_factory.mktemp("page") / "index.html"
    write_page(path, true_scene(), Planar(), CAMERAS, "A <tiny> scene & more")
    with Browser(path, 320, 240) as browser:
        yield browser


@needs_browser
@pytest.mark.parametrize("layer", ["rgb", "without_panes", "reflection", "strength"])
def test_every_layer_is_what_the_renderer_shows(opened: Browser, layer: str) -> None:
    for _, camera in CAMERAS[:2]:
        assert likeness(opened, true_scene(), Planar(), camera, layer) > 36


@needs_browser
def test_splats_outside_the_image_are_skipped(opened: Browser) -> None:
    """At close range, through a long lens with an offset centre, most of the scene is outside the image."""
    for _, camera in CAMERAS[:2]:
        near = replace(camera, fx=4 * camera.fx, fy=4 * camera.fy, cx=1.5 * camera.cx, cy=0.5 * camera.cy)
        assert likeness(opened, true_scene(), Planar(), near) > 36
        assert likeness(opened, true_scene(), Planar(), near, "reflection") > 36
    sorted_of = """glassplat.then(async ({ navigation, ordersOf }) => {
      const found = [];
      for (const middle of [160, -3000]) {
        const lens = { intrinsics: [1600, 1600, middle, 120], size: [320, 240] };
        let orders = null;  // As it is where the page itself asks for another order meanwhile.
        while (!orders) orders = await ordersOf(navigation.pose(), lens);
        found.push(orders.map((order) => [...order]));
      }
      return found;
    })"""
    for seen, beside in zip(*opened.evaluate(sorted_of), strict=True):
        assert 2 * len(beside) < len(seen)


@needs_browser
def test_the_first_view_looks_past_the_middle_as_its_photograph_does(tmp_path: Path) -> None:
    name, camera = CAMERAS[0]
    aside = replace(camera, fy=camera.fx, cx=0.8 * camera.width, cy=0.3 * camera.height)
    write_page(tmp_path / "index.html", true_scene(), Planar(), [(name, aside)], "aside")
    with Browser(tmp_path / "index.html", 10 * camera.width, 10 * camera.height) as browser:
        found = browser.evaluate("glassplat.then(({ lensOf }) => lensOf())")
        size = found["size"]
        expected = [aside.fx / aside.width * size[0], aside.fy / aside.height * size[1], 0.8 * size[0], 0.3 * size[1]]
        assert found["intrinsics"] == pytest.approx(expected, rel=1e-3)


@needs_browser
def test_the_buttons_work(opened: Browser) -> None:
    camera = CAMERAS[1][1]
    plain = picture(opened, camera)
    opened.keys("m")
    assert likeness(opened, as_mirrors(true_scene(), [1]), Planar(), camera) > 36
    opened.keys("m")
    opened.keys("g")
    assert likeness(opened, without_glass(true_scene()), Planar(), camera) > 36
    opened.keys("g")
    assert torch.equal(picture(opened, camera), plain)
    opened.evaluate("document.querySelector('[data-set=\"layer=strength\"]').click()")
    assert opened.evaluate("glassplat.then(page => page.panel.state.layer)") == "strength"
    opened.keys("1")


@needs_browser
def test_keys_of_a_slider_stay_its_own_and_others_work(opened: Browser) -> None:
    state = "glassplat.then(({ panel: { state } }) => [state.compare, state.divider, state.reflectances[0]])"
    photo = opened.evaluate("document.getElementById('photo').textContent")
    *_, before = opened.evaluate(state)
    opened.evaluate("document.getElementById('reflectance').focus() || document.body.classList.remove('touched')")
    opened.keys("c")
    assert opened.evaluate("document.body.classList.contains('touched')")
    opened.keys("Right")
    compares, divider, brighter = opened.evaluate(state)
    assert compares and brighter > before
    over = """glassplat.then(({ panel }) => {
      const { x, y } = document.querySelector('nav [data-do=help]').getBoundingClientRect();
      panel.set('divider', x / innerWidth);
      return document.elementFromPoint(x + 5, y + 5).closest('nav') !== null;
    })"""
    assert opened.evaluate(over), "the divider does not lie over the buttons"
    opened.evaluate(f"glassplat.then(({{ panel }}) => panel.set('divider', {divider}))")
    opened.evaluate("document.getElementById('divider').focus()")
    opened.keys("Left")
    _, moved, same = opened.evaluate(state)
    assert moved < divider and same == brighter
    assert int(opened.evaluate("document.getElementById('divider').ariaValueNow")) == round(100 * moved)
    opened.keys("c")
    assert opened.evaluate("document.getElementById('photo').textContent") == photo
    opened.evaluate("document.getElementById('reflectance').dispatchEvent(new Event('dblclick'))")
    opened.evaluate("document.getElementById('view').focus()")


@needs_browser
def test_a_held_key_toggles_once(opened: Browser) -> None:
    pressed = "document.body.dispatchEvent(new KeyboardEvent('keydown', { key: 'c', bubbles: true, repeat: REPEAT }))"
    compares = []
    for repeat in ("false", "true", "true", "false"):
        opened.evaluate(pressed.replace("REPEAT", repeat))
        compares.append(opened.evaluate("glassplat.then(({ panel }) => panel.state.compare)"))
    assert compares == [True, True, True, False]


@needs_browser
def test_glass_turns_into_a_mirror_by_degrees(opened: Browser) -> None:
    shares = opened.evaluate("""glassplat.then(({ panel }) => {
      const found = [], note = () => found.push(panel.wanted().reflectances[0]);
      panel.turn(1);
      note();
      panel.set('glass', 'mirror');
      for (let k = 0; k < 4; k++) { panel.turn(0.25); note(); }
      found.push(panel.turn(0.25));
      panel.set('glass', 'real');
      panel.turn(1);
      note();
      return found;
    })""")
    glass, *mirrors, turning, again = shares
    assert glass < mirrors[0] < mirrors[1] < mirrors[2] < mirrors[3] and mirrors[3] > 0.999
    assert turning is False and again == glass


@needs_browser
def test_the_next_photograph_shows_a_pane_and_stands_in_the_address(tmp_path: Path) -> None:
    name, camera = CAMERAS[0]
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=camera.cam_from_world.dtype))
    away = replace(camera, cam_from_world=turned @ camera.cam_from_world)
    write_page(tmp_path / "index.html", true_scene(), Planar(), [("away.png", away), *CAMERAS], "Route")
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        stops = set()
        browser.wait("glassplat.then(() => true)", "the page")
        for _ in range(len(CAMERAS) + 1):
            browser.keys("Right")
            address = browser.evaluate("decodeURIComponent(location.hash)")
            assert address == "#view=" + browser.evaluate("document.getElementById('photo').textContent")
            stops.add(address.removeprefix("#view="))
        assert stops == {stop for stop, _ in CAMERAS}
        browser.evaluate(f"location.hash = '#view={name}'")
        browser.wait(f"document.getElementById('photo').textContent === '{name}'", "the photograph in the address")
        browser.wait("glassplat.then(({ navigation }) => !navigation.advance(0))", "the end of the flight")
        position = "glassplat.then(({ scene, navigation }) => { const { rotation, offset } = navigation.pose();"
        position += " const view = scene.views.find(({ name }) => name === '" + name + "');"
        position += " return [0, 1, 2].map((c) => -[0, 1, 2].reduce((s, r) => s + rotation[3 * r + c] * offset[r], 0)"
        position += " - view.position[c]); })"
        assert max(abs(value) for value in browser.evaluate(position)) < 1e-6
        assert browser.complaints() == []


@needs_browser
def test_photographs_from_one_point_come_one_after_the_other(tmp_path: Path) -> None:
    first = CAMERAS[0][1]
    cosine, sine = math.cos(0.05), math.sin(0.05)
    turn = torch.tensor([[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]])
    poses = [torch.linalg.matrix_power(turn, k) @ first.cam_from_world for k in range(4)]
    cameras = [(f"{k}.png", replace(first, cam_from_world=pose)) for k, pose in enumerate(poses)]
    write_page(tmp_path / "index.html", true_scene(), Planar(), cameras, "Round")
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        stops = set()
        for _ in cameras:
            browser.wait("glassplat.then(({ navigation }) => navigation.advance(10) || true)", "the end of the flight")
            browser.keys("Right")
            stops.add(browser.evaluate("document.getElementById('photo').textContent"))
        assert len(stops) == 4


@needs_browser
def test_people_stay_near_the_photographs(opened: Browser) -> None:
    farthest = """glassplat.then(({ navigation, scene }) => {
      let most = 0;
      for (let k = 0; k < 200; k++) {
        navigation.orbit(Math.sin(k), Math.cos(3 * k));
        navigation.pan(Math.sin(7 * k), 0.3);
        navigation.walk(k % 3, 1, -1);
        navigation.dolly(k % 2 ? 3 : 0.2);
        const { rotation, offset } = navigation.pose();
        const at = [0, 1, 2].map((c) => -[0, 1, 2].reduce((sum, r) => sum + rotation[3 * r + c] * offset[r], 0));
        const distances = scene.views.map(({ position }) => Math.hypot(...position.map((x, c) => x - at[c])));
        most = Math.max(most, Math.min(...distances) / scene.reach);
      }
      return most;
    })"""
    assert 0.5 < opened.evaluate(farthest) < 1.001


@needs_browser
@pytest.mark.parametrize("notch", [0.12, -0.12])
def test_a_drag_continues_after_the_wheel_reached_its_limit(notch: float, opened: Browser) -> None:
    turned = """glassplat.then(({ navigation, scene }) => {
      navigation.flyTo(scene.views[scene.first]);
      navigation.advance(1);
      navigation.orbit(0.4, 0);
      for (let k = 0; k < 30; k++) navigation.dolly(Math.exp(NOTCH));
      const forward = () => navigation.pose().rotation.slice(6), before = forward();
      navigation.orbit(0.003, 0);
      return Math.acos(Math.min(1, forward().reduce((sum, x, k) => sum + x * before[k], 0)));
    })"""
    assert math.degrees(opened.evaluate(turned.replace("NOTCH", str(notch)))) < 0.5


@needs_browser
def test_the_first_view_stands_in_the_address_too(opened: Browser) -> None:
    opened.wait("glassplat.then(() => true)", "the page")
    opened.keys("Right")
    opened.keys("r")
    first = opened.evaluate("glassplat.then(({ scene }) => scene.views[scene.first].name)")
    assert opened.evaluate("document.getElementById('photo').textContent") == first
    assert opened.evaluate("location.hash") == f"#view={first}"


@needs_browser
def test_the_address_may_name_a_photograph_as_it_is_typed(tmp_path: Path) -> None:
    names = ["left/1 é.png", "50%.png"]
    cameras = list(zip(names, (camera for _, camera in CAMERAS), strict=False))
    write_page(tmp_path / "index.html", true_scene(), Planar(), cameras, "Typed")
    with Browser(tmp_path / "index.html", 320, 240, query="#view=" + names[0]) as browser:
        browser.wait("glassplat.then(() => true)", "the page")
        for typed in (names[1], names[0], quote(names[1]), quote(names[0], safe="")):
            browser.evaluate(f"location.hash = '#view={typed}'")
            browser.wait(f"document.getElementById('photo').textContent === '{unquote(typed)}'", typed)


@needs_browser
def test_a_touch_does_not_tilt_a_camera_that_looks_straight_down(opened: Browser) -> None:
    up = torch.tensor(opened.evaluate("glassplat.then(({ scene }) => scene.up)"), dtype=torch.float32)
    right = torch.nn.functional.normalize(torch.tensor([0.0, -up[2], up[1]]), dim=0)
    rows = [*right.tolist(), *torch.linalg.cross(-up, right).tolist(), *(-up).tolist()]
    turned = """glassplat.then(({ navigation, scene }) => {
      const before = navigation.pose(), rotation = ROWS, [x, y, z] = scene.views[0].position;
      const offset = [0, 3, 6].map((k) => -(rotation[k] * x + rotation[k + 1] * y + rotation[k + 2] * z));
      navigation.place({ rotation, offset });
      navigation.orbit(0, 0);
      const forward = navigation.pose().rotation.slice(6);
      navigation.place(before);
      return forward;
    })"""
    forward = torch.tensor(opened.evaluate(turned.replace("ROWS", str(rows))), dtype=torch.float32)
    torch.testing.assert_close(forward, -up, atol=1e-5, rtol=0)


UNTIL = "const until = async (holds) => { while (!holds()) await new Promise((next) => setTimeout(next, 5)); };"


def dusty_scene() -> Scene:
    """The tiny scene with many Gaussians smaller than a pixel added to it."""
    scene = true_scene()
    primary, few = scene.primary, len(scene.primary)
    dust = primary.select(torch.arange(3000) % few)
    spread = torch.randn(dust.means.shape, generator=torch.Generator().manual_seed(0))
    dust = dust.with_tensors({"means": dust.means + 0.3 * spread, "log_scales": torch.full_like(dust.log_scales, -6.0)})
    return replace(scene, primary=primary.concat(dust))


@pytest.fixture(scope="module")
def dusty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    path = tmp_path_factory.mktemp("page") / "index.html"
    write_page(path, dusty_scene(), Planar(), CAMERAS, "Dust")
    with Browser(path, 320, 240) as browser:
        yield browser


@needs_browser
def test_fewer_splats_are_drawn_during_motion(dusty: Browser) -> None:
    moved = (
        UNTIL
        + """
      const page = await glassplat, { navigation, noted, pace } = page;
      pace.scale = () => 0.35;  // However fast the machine is.
      noted.length = 0;
      while (noted.length < 4) {  // The first may still be of the order before.
        navigation.orbit(0.002, 0);
        await new Promise((next) => setTimeout(next, 10));
      }
      const moving = noted.at(-1);
      await until(() => noted.at(-1)?.scale === 1);
      const orders = await page.ordersOf(navigation.pose(), page.lensOf());
      return [moving, noted.at(-1), orders.reduce((sum, order) => sum + order.length, 0)];
    """
    )
    moving, resting, every = dusty.evaluate(f"(async () => {{ {moved} }})()")
    assert moving["scale"] < 1 and moving["splats"] < 0.7 * every
    assert resting["splats"] == every


@needs_browser
def test_the_final_image_equals_the_image_drawn_at_once(dusty: Browser) -> None:
    """Refined by a few splats at a time; compared with an image of the same camera drawn at once."""
    dusty.keys("h")
    dusty.evaluate("glassplat.then(({ pace, navigation }) => { pace.most = () => 150; navigation.orbit(0.05, 0.02); })")
    dusty.wait("glassplat.then(({ noted, isRefining }) => noted.at(-1)?.scale < 1 || isRefining())", "a coarse picture")
    dusty.wait("glassplat.then(({ noted }) => noted.at(-1)?.scale === 1)", "the whole picture")
    dusty.wait("document.getAnimations().length === 0", "the controls to be gone")
    dusty.evaluate("new Promise((next) => requestAnimationFrame(() => requestAnimationFrame(next)))")
    shown = torch.from_numpy(dusty.picture())
    whole = """glassplat.then((page) => {
      const { rotation, offset } = page.navigation.pose(), { intrinsics, size: [width, height] } = page.lensOf();
      const [fx, fy, cx, cy] = intrinsics;
      const position = [0, 1, 2].map((c) => -[0, 1, 2].reduce((sum, r) => sum + rotation[3 * r + c] * offset[r], 0));
      return page.picture({ rotation, position, fx, fy, cx, cy, width, height });
    })"""
    assert psnr(shown, pixels_of(dusty.evaluate(whole), 320, 240).float() / 255) > 50
    dusty.keys("h")


@needs_browser
def test_a_gesture_interrupts_refinement(dusty: Browser) -> None:
    interrupted = (
        UNTIL
        + """
      const page = await glassplat, { navigation, noted, pace } = page;
      pace.scale = () => 0.35;
      pace.most = () => 20;  // A whole picture takes so many steps that it cannot be done before the gesture.
      navigation.orbit(0.05, 0);
      await until(() => page.isRefining());
      noted.length = 0;
      navigation.orbit(0.02, 0);
      await until(() => noted.length > 0);
      pace.most = () => Infinity;
      await until(() => noted.at(-1)?.scale === 1);
      return noted.map(({ scale }) => scale);
    """
    )
    scales = dusty.evaluate(f"(async () => {{ {interrupted} }})()")
    assert scales[0] < 0.5 and scales[-2:] == [0.5, 1] and max(scales[:-2]) < 0.5


@needs_browser
def test_a_gpu_draws_all_splats_in_every_frame(tmp_path: Path) -> None:
    """The page treats this machine's processor as one; it then blends in half precision, and draws at once."""
    path = tmp_path / "index.html"
    write_page(path, dusty_scene(), Planar(), CAMERAS, "Dust")
    path.write_text(path.read_text().replace("/swiftshader|", "/a name that none has|").replace("|software|", "|"))
    with Browser(path, 320, 240) as browser:
        for _, camera in CAMERAS[:2]:
            assert likeness(browser, dusty_scene(), Planar(), camera) > 36
        drawn = (
            UNTIL
            + """
          const page = await glassplat, { navigation, noted, ordersOf, lensOf } = page;
          await until(() => noted.some(({ scale }) => scale === 1));
          noted.length = 0;
          navigation.orbit(0.0001, 0);
          await until(() => noted.length > 1 && performance.now() - noted.at(-1).time > 500);
          const orders = await ordersOf(navigation.pose(), lensOf());
          return [noted.map(({ splats }) => splats), orders.reduce((sum, order) => sum + order.length, 0)];
        """
        )
        splats, every = browser.evaluate(f"(async () => {{ {drawn} }})()")
        assert splats[-1] == every
        # On the way, a few splats enter or leave the image with each order; thinning would remove many.
        assert all(abs(count - every) < 0.02 * every for count in splats)


@needs_browser
def test_the_page_requests_nothing_and_logs_no_errors(opened: Browser) -> None:
    opened.drag([(100, 100), (160, 120)])
    opened.keys("Right")
    assert {address.split(":")[0] for address in opened.requests()} <= {"file", "data", "blob"}
    assert opened.complaints() == []
    assert opened.evaluate("document.title") == "A <tiny> scene & more"


def shining(mirrored: str) -> tuple[Scene, Renderer]:
    """Glossy objects of some thickness in a distant environment, or among objects far enough away to look distant."""
    scene = in_single_precision(glossy_scene(0.6, size=8))
    scene = replace(scene, environment=Environment(scene.environment.raw.float()))
    flat = scene.primary.log_scales + torch.tensor([0.5, 0.5, -2.0])
    primary = scene.primary.with_tensors({"log_scales": flat})
    if mirrored == "distant":
        return replace(scene, primary=primary), Deferred()
    generator = torch.Generator().manual_seed(1)
    away = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator), dim=1)
    around = Gaussians(
        means=200 * away,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(40, 1),
        log_scales=torch.full((40, 3), math.log(30.0)),
        logit_opacities=torch.full((40,), 3.0),
        sh=torch.rand(40, 1, 3, generator=generator) * 3 - 1.5,
        channels={},
    )
    return replace(scene, primary=primary, surroundings=around), Traced()


@pytest.mark.parametrize("mirrored", ["distant", "near"])
def test_reflections_agree_in_double_precision(mirrored: str) -> None:
    scene, renderer = shining(mirrored)
    double = scene.with_parameters({name: tensor.double() for name, tensor in scene.parameters().items()})
    faces = [bytearray(cube_bytes(each, renderer.page_settings())) for each in (scene, double)]
    single, other = (torch.frombuffer(each, dtype=torch.uint8).int() for each in faces)
    assert int((single - other).abs().max()) <= 1


@needs_browser
@pytest.mark.parametrize("mirrored", ["distant", "near"])
def test_glossy_objects_reflect_their_surroundings(mirrored: str, tmp_path: Path) -> None:
    scene, renderer = shining(mirrored)
    poses = [camera_at(x, y, 0.0) for x, y in ((0.1, -0.2), (-0.4, 0.3))]
    cameras = [(f"{k}.png", replace(at, cam_from_world=at.cam_from_world.float())) for k, at in enumerate(poses)]
    write_page(tmp_path / "index.html", scene, renderer, cameras, "Shining")
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        for _, camera in cameras:
            large = camera.resize(8 * camera.width, 8 * camera.height)
            frame = renderer(scene, large)
            layers = {"rgb": frame.rgb, "without_panes": frame.layers["base"]}
            layers |= {name: frame.layers[name] for name in ("reflection", "strength")}
            for layer, image in layers.items():
                image = image if image.dim() == 3 else image[..., None].expand(-1, -1, 3)
                found = psnr(picture(browser, large, layer), image.float().clamp(0, 1))
                # Reflections have sharp edges where the reflected direction changes quickly.
                assert found > (20 if layer == "reflection" else 34), (layer, found)
        shown = browser.evaluate("[...document.querySelectorAll('#dock button')].filter((b) => b.offsetParent).length")
        assert shown == 5, "four layers and the comparison"
        assert browser.complaints() == []


def test_the_page_is_one_file_of_little_script() -> None:
    page = page_text(true_scene(), Planar(), CAMERAS, "title")
    outside = re.findall(r"(?:src|href|url)\s*[=(]\s*[\"']?(?!data:)[a-z]+:", page)
    assert not outside and "http://" not in page and "https://" not in page and "<noscript>" in page
    assert sum(len(read_asset(name)) for name in (*SCRIPTS, *SHADERS)) <= LARGEST_SCRIPT


@pytest.mark.parametrize("folder", ["https://x.org", "https://x.org/shop", "https://x.org/shop/v1.2"])
def test_a_link_has_its_picture_in_the_folder_of_the_page(folder: str) -> None:
    for rest in ("", "/", "/index.html", "?a=b", "/?a=b/c", "#top", "/index.html?a=b#view=1.png"):
        assert f'<meta property="og:image" content="{folder}/preview.jpg">' in preview_tags(folder + rest), rest


def test_a_link_to_the_page_is_shown_with_a_picture_of_both_sides(tmp_path: Path) -> None:
    url = "https://x.org/shop/index.html"
    page = page_text(true_scene(), Planar(), CAMERAS, "title", sharing=Sharing("A <person>, CC0", url))
    tags = dict(re.findall(r'<meta property="(og:[^"]+)" content="([^"]*)">', page))
    assert tags["og:title"] == "title" and tags["og:description"] and tags["og:url"] == url
    assert tags["og:image"] == "https://x.org/shop/preview.jpg" and "A &lt;person&gt;, CC0" in page
    write_preview(tmp_path / "preview.jpg", true_scene(), Planar(), CAMERAS)
    with Image.open(tmp_path / "preview.jpg") as picture:
        assert picture.size == (int(tags["og:image:width"]), int(tags["og:image:height"])) == (1200, 630)
        assert min(picture.getpixel((600, 315))) > 250


@needs_browser
def test_a_page_on_disk_has_to_be_uploaded_before_it_is_embedded(opened: Browser) -> None:
    opened.evaluate("document.querySelector('[data-do=embed]').click()")
    assert "upload it" in opened.evaluate("document.querySelector('#embed textarea').value")
    shown = "['help', 'embed'].filter((id) => !document.getElementById(id).hidden)"
    opened.evaluate("document.querySelector('[data-do=help]').click()")
    assert opened.evaluate(shown) == ["help"]
    opened.evaluate("document.querySelector('[data-do=embed]').click()")
    assert opened.evaluate(shown) == ["embed"]
    opened.keys("Escape")
    assert opened.evaluate(shown) == []


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves files without log messages."""

    def log_message(self, *words: object) -> None:
        """Suppresses log messages."""


@needs_browser
def test_on_the_web_the_page_gives_the_frame_that_embeds_it(opened: Browser, tmp_path: Path) -> None:
    write_page(tmp_path / "index.html", true_scene(), Planar(), CAMERAS, "A <tiny> scene & more")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=tmp_path)) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        with Browser(f"http://127.0.0.1:{server.server_address[1]}/index.html", 320, 240) as window:
            window.wait("document.body.classList.contains('ready')", "the page")
            window.evaluate("document.querySelector('[data-do=embed]').click()")
            code = window.evaluate("document.querySelector('#embed textarea').value")
        server.shutdown()
    assert re.match(r'<iframe src="http://[^"]*/index.html[^"]*" title="A &#60;tiny> scene &#38; more" ', code)


def test_names_cannot_end_the_script() -> None:
    page = page_text(true_scene(), Planar(), [("</script><b>{{title}}", CAMERAS[0][1])], "</title><script>")
    assert "</script><b>" not in page and "</title><script>" not in page
    assert "\\u003c/script>\\u003cb>{{title}}" in page
    assert fill_template("a{{x}}b", {"x": "{{x}}"}) == "a{{x}}b"


def test_a_page_keeps_what_photographs_show_of_more_gaussians_than_it_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, cameras = true_scene(), [camera for _, camera in CAMERAS]
    faint = scene.primary.with_tensors({"logit_opacities": torch.full_like(scene.primary.logit_opacities, -5)})
    crowded = replace(scene, primary=concatenated(faint, scene.primary))
    assert fits_page(crowded) and select_for_page(crowded, cameras) is crowded
    monkeypatch.setattr(web_page, "MOST_GAUSSIANS", len(scene.primary) + len(scene.glass))
    assert not fits_page(crowded)
    kept, count = select_for_page(crowded, cameras), len(scene.primary)
    assert len(kept.primary) == count
    for camera in cameras:
        assert psnr(Planar()(kept, camera).rgb, Planar()(crowded, camera).rgb) > 40
    assert f"{count:,} of {2 * count:,} Gaussians" in page_text(crowded, Planar(), CAMERAS, "title")
    assert f"{count:,} Gaussians" in page_text(scene, Planar(), CAMERAS, "title")


@pytest.mark.parametrize("extent", [1e-4, 1e4])
def test_a_page_shows_a_scene_in_any_unit(extent: float, caplog: pytest.LogCaptureFixture) -> None:
    """In millimetres or kilometres, most Gaussians have sizes outside the range of SPZ."""
    found = []
    for length in (1.0, extent):
        factor = length / true_scene().extent
        cameras = [(name, camera.scale(factor)) for name, camera in CAMERAS]
        page = page_text(scale_scene(true_scene(), factor), Planar(), cameras, "title")
        found.append([float(value) for value in re.findall(r'"(?:near|reach)": ?([^,}]+)', page)])
    assert len(found[0]) == 2 and found[1] == pytest.approx(found[0], rel=1e-4)
    assert not caplog.messages


@pytest.mark.parametrize("broken", ["cameras", "values"])
def test_scenes_that_cannot_be_shown_are_refused(broken: str, tmp_path: Path) -> None:
    scene = true_scene()
    cameras = [] if broken == "cameras" else CAMERAS
    if broken == "values":
        means = torch.full_like(scene.primary.means, torch.inf)
        scene = replace(scene, primary=scene.primary.with_tensors({"means": means}))
    with pytest.raises(ValueError, match=broken if broken == "cameras" else "means"):
        write_page(tmp_path / "a.html", scene, Planar(), cameras, "title")
    assert not (tmp_path / "a.html").exists()
