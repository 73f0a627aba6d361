"""Several panes in a page: behind one another, adjacent, and only the nearest one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.publish.web_page import write_page
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene, as_mirrors, covering_glass
from tests.browser_needed import needs_browser
from tests.publish.test_web_page import CAMERAS, likeness
from tests.render.test_seen_panes import vitrine
from tests.render.tiny_scene import in_single_precision, joined, pane, showcase
from tools.browser import Browser

pytestmark = pytest.mark.usefixtures("one_chromium")

SPLATS_OF_MASKS = """glassplat.then(async ({ navigation, lensOf, ordersOf }) => {
  let orders = null;  // As it is where the page itself asks for another order meanwhile.
  while (!orders) orders = await ordersOf(navigation.pose(), lensOf());
  return orders.slice(1, -2).map((order) => order?.length ?? 0);
})"""


@needs_browser
def test_panes_behind_panes_and_scenes_without_panes(tmp_path: Path) -> None:
    panes = joined(pane(2.0, half=0.8), pane(3.0, half=0.9, label=2))
    tint = torch.tensor([[-0.6, -0.1, -0.4], [0.0, -0.5, 0.0]], dtype=torch.float64)
    two = in_single_precision(showcase(replace(panes, log_transmittances=tint)))
    for name, scene, renderer in (("two", two, Planar()), ("none", Scene(two.primary, two.extent), Splat())):
        write_page(tmp_path / f"{name}.html", scene, renderer, CAMERAS, name)
        with Browser(tmp_path / f"{name}.html", 320, 240) as browser:
            for _, camera in CAMERAS[:2]:
                assert likeness(browser, scene, renderer, camera) > 36
            assert browser.complaints() == []


@needs_browser
def test_only_the_nearest_pane_is_blended_on_request(tmp_path: Path) -> None:
    scene, renderer = in_single_precision(vitrine(1, 2)), Planar(nearest_only=True)
    write_page(tmp_path / "index.html", scene, renderer, CAMERAS, "nearest")
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        for _, camera in CAMERAS[:2]:
            assert likeness(browser, scene, renderer, camera) > 45
            for layer in ("strength", "reflection"):
                assert likeness(browser, scene, renderer, camera, layer) > 45
        assert browser.complaints() == []


def upright_pane(x: float, label: int, half: float = 0.4) -> Planes:
    """One of several adjacent panes across the z axis, whose glass overlaps with that of its neighbours."""
    upright = pane(2.0, half=half, label=label)
    center, facing = torch.tensor([[x, 0.0, 2.0]]).double(), torch.tensor([[0.0, 0.0, -1.0]]).double()
    return upright.with_tensors({"centers": center, "raw_normals": facing})


@needs_browser
def test_adjacent_panes_do_not_fade_at_their_common_edge(tmp_path: Path) -> None:
    panes = joined(*(upright_pane(x, label) for label, x in enumerate((-0.8, 0.0, 0.8), start=1)))
    scene, renderer = in_single_precision(showcase(panes)), Planar()
    write_page(tmp_path / "index.html", scene, renderer, CAMERAS, "three")
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        for _, camera in CAMERAS[:2]:
            for layer in ("strength", "reflection"):
                assert likeness(browser, scene, renderer, camera, layer) > 55
        assert browser.complaints() == []


@needs_browser
def test_a_pane_has_a_mask_of_its_own_only_where_another_may_be_seen_through_it(tmp_path: Path) -> None:
    apart = joined(upright_pane(-1.2, 1), upright_pane(1.2, 2))
    for name, panes, own in (("apart", apart, False), ("behind", joined(pane(2.0), pane(3.0, label=2)), True)):
        write_page(tmp_path / f"{name}.html", in_single_precision(showcase(panes)), Planar(), CAMERAS, name)
        with Browser(tmp_path / f"{name}.html", 320, 240) as browser:
            joint, *each = browser.evaluate(SPLATS_OF_MASKS)
            assert joint > 0 and len(each) == 2
            assert all(each) if own else not any(each)


@needs_browser
def test_one_of_many_panes_is_chosen_from_a_list(tmp_path: Path) -> None:
    panes = joined(*(upright_pane(0.2 * label - 1.0, label, half=0.1) for label in range(1, 9)))
    scene = in_single_precision(showcase(panes))
    write_page(tmp_path / "index.html", scene, Planar(), CAMERAS, "eight")
    with Browser(tmp_path / "index.html", 1280, 720) as browser:
        sides = "(({ left, right }) => [left, right])(document.querySelector('#dock').getBoundingClientRect())"
        dock = browser.evaluate(f"glassplat.then(() => {sides})")
        assert 0 <= dock[0] < dock[1] <= 1280
        choose = "list.value = '4'; list.dispatchEvent(new Event('change'));"
        browser.run(f"const list = document.querySelector('#panes'); list.focus(); {choose}")
        browser.keys("m")
        assert likeness(browser, as_mirrors(scene, [5]), Planar(), CAMERAS[1][1]) > 36
        browser.keys("g")
        without = replace(scene, planes=scene.planes.select([0, 1, 2, 3, 5, 6, 7]))
        assert likeness(browser, without, Planar(), CAMERAS[1][1], "strength") > 60


@needs_browser
def test_a_large_window_with_many_panes_is_drawn_more_coarsely(tmp_path: Path) -> None:
    """Every pane has its own images of the size of the window; 24 of them would need a gigabyte here."""
    panes = joined(*(upright_pane(0.1 * label - 1.2, label, half=0.05) for label in range(1, 25)))
    write_page(tmp_path / "index.html", in_single_precision(showcase(panes)), Planar(), CAMERAS, "many")
    with Browser(tmp_path / "index.html", 2000, 1500) as browser:
        width, height = browser.evaluate("glassplat.then(({ lensOf }) => lensOf().size)")
        assert 900 < width < 1200 and abs(width / height - 4 / 3) < 0.01
        assert browser.complaints() == []


@needs_browser
@pytest.mark.parametrize("label", [1, 2])
def test_a_pane_without_glass_does_not_use_the_glass_of_another(label: int, tmp_path: Path) -> None:
    panes = joined(pane(2.0, half=0.8), pane(3.0, half=0.9, label=2))
    scene = in_single_precision(showcase(panes))
    scene = replace(scene, glass=covering_glass(scene.planes.select([label - 1])))
    write_page(tmp_path / "index.html", scene, Planar(), CAMERAS, "one has glass")
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        for _, camera in CAMERAS[:2]:
            for layer in ("rgb", "reflection", "strength"):
                assert likeness(browser, scene, Planar(), camera, layer) > 42


@needs_browser
def test_removing_a_pane_removes_its_glass(tmp_path: Path) -> None:
    scene = in_single_precision(showcase(joined(pane(2.0, half=0.8), pane(3.0, half=0.9, label=2))))
    between = scene.primary.select(torch.tensor([0])).with_tensors(
        {
            "means": torch.tensor([[-0.4, 0.0, 2.5]]),
            "log_scales": torch.full((1, 3), -1.4),
            "logit_opacities": torch.tensor([8.0]),
        }
    )
    scene = replace(scene, primary=scene.primary.concat(between), glass=covering_glass(scene.planes))
    write_page(tmp_path / "index.html", scene, Planar(), CAMERAS, "a thing between two")
    with Browser(tmp_path / "index.html", 320, 240) as browser:
        browser.evaluate("glassplat.then(({ panel }) => { panel.set('pane', '0'); panel.set('glass', 'none'); })")
        left = scene.planes.select([1])
        without = replace(scene, planes=left, glass=covering_glass(left))
        for layer in ("rgb", "strength"):
            assert likeness(browser, without, Planar(), CAMERAS[1][1], layer) > 45
