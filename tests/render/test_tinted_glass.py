"""Glass with a separate transmittance for red, green and blue."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from glassplat.kernels.maths.images import linear_from_srgb
from glassplat.options import Blend
from glassplat.render.panes import tint_by_panes
from glassplat.render.planar import Planar
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import CAMERA, assert_gradient_matches, pane, showcase

GREENISH = torch.tensor([[0.6, 0.9, 0.7]], dtype=torch.float64)


def of_glass(planes: Planes, transmittances: Tensor = GREENISH) -> Planes:
    return replace(planes, log_transmittances=transmittances.log().expand(len(planes), 3).clone())


def tinted_showcase() -> Scene:
    return replace(showcase(), planes=of_glass(showcase().planes))


@pytest.mark.parametrize("blend", ["srgb", "linear"])
def test_clear_glass_changes_nothing(blend: Blend) -> None:
    plain = Planar(blend=blend)(showcase(), CAMERA)
    clear = Planar(blend=blend)(replace(showcase(), planes=showcase().planes.that_may_tint()), CAMERA)
    torch.testing.assert_close(clear.rgb, plain.rgb, atol=1e-6, rtol=0)
    for name, layer in plain.layers.items():
        torch.testing.assert_close(clear.layers[name], layer, atol=1e-6, rtol=0)


def test_what_is_behind_is_darker_by_the_transmittance_and_nothing_else_changes() -> None:
    plain, frame = Planar()(showcase(), CAMERA), Planar()(tinted_showcase(), CAMERA)
    shown = (plain.layers["mask"] > 0.2) & (plain.layers["pane"] >= 0)
    assert int(shown.sum()) > 50
    behind, through = (linear_from_srgb(f.layers["transmission"][shown]) for f in (plain, frame))
    left = 1 - plain.layers["mask"][shown][:, None] * (1 - GREENISH)
    torch.testing.assert_close(through, left * behind, atol=1e-4, rtol=0)
    torch.testing.assert_close(frame.layers["tint"][shown], left)
    assert "tint" not in plain.layers
    assert float((behind - through).max()) > 0.02
    for name in ("reflection", "strength", "without_panes", "mask", "depth"):
        assert torch.equal(frame.layers[name], plain.layers[name]), name
    outside = plain.layers["mask"] == 0
    assert torch.equal(frame.rgb[outside], plain.rgb[outside])
    assert bool((frame.layers["tint"][outside] == 1).all())


def test_panes_without_reflection_only_tint() -> None:
    planes = of_glass(pane(2.0, half=0.8).concat(pane(1.2, half=0.5, label=2)))
    planes = planes.with_tensors({"logit_reflectances": torch.full((2,), -50.0, dtype=torch.float64)})
    layers = (frame := Planar(blend="srgb")(showcase(planes), CAMERA)).layers
    torch.testing.assert_close(layers["tint"] * layers["without_panes"], frame.rgb)
    one = Planar(blend="srgb")(showcase(planes.select([0])), CAMERA).layers["tint"]
    assert float((one - layers["tint"]).amax()) > 0.01


def test_layers_recombine_to_the_image() -> None:
    layers = (frame := Planar(blend="srgb")(tinted_showcase(), CAMERA)).layers
    strength = layers["strength"][..., None]
    torch.testing.assert_close((1 - strength) * layers["transmission"] + strength * layers["reflection"], frame.rgb)


def test_gradients_of_one_pane_match_finite_differences() -> None:
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(4, 5, 3, generator=generator, dtype=torch.float64) + 0.1
    mask = 0.9 * torch.rand(4, 5, generator=generator, dtype=torch.float64) + 0.05
    shares = torch.tensor([[0.6, 0.9, 0.7], [0.5, 0.4, 0.8]], dtype=torch.float64)
    which = torch.randint(-1, 2, (4, 5), generator=generator)
    for blend in ("srgb", "linear"):
        inputs = tuple(tensor.clone().requires_grad_() for tensor in (image, mask, shares))
        assert torch.autograd.gradcheck(lambda i, m, t, b=blend: tint_by_panes(i, m, which, t, b), inputs)
    unshown = which < 0
    assert torch.equal(tint_by_panes(image, mask, which, shares, "linear")[unshown], image[unshown])


def test_gradients_match_finite_differences_through_the_whole_renderer() -> None:
    assert_gradient_matches(Planar(), tinted_showcase(), "planes.log_transmittances")


def test_clear_and_tinted_panes_join() -> None:
    both = of_glass(pane(2.0, label=2)).concat(pane(3.0, label=1))
    assert both.labels == (1, 2) and both.transmittances is not None
    torch.testing.assert_close(both.transmittances, torch.cat([torch.ones_like(GREENISH), GREENISH]))
    assert pane(2.0, label=2).concat(pane(3.0, label=1)).transmittances is None
