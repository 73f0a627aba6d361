"""Reflections with a colour: strengths of red, green and blue, in every renderer that mirrors."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from glassplat.render.deferred import Deferred
from glassplat.render.frame import Renderer
from glassplat.render.layers import renderer_with
from glassplat.render.tint import tint_layer
from glassplat.render.traced import Traced
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.scene.tint import TINT, excess_strengths, with_tint
from tests.render import test_deferred, test_traced
from tests.render.tiny_scene import camera_at

RENDERERS: dict[str, Renderer] = {
    "deferred": Deferred(),
    "without depth": Deferred(depth=False),
    "forward": Deferred(shading="forward"),
    "traced": Traced(),
    "traced discs": Traced(),
}
EACH = pytest.mark.parametrize("name", RENDERERS)


def glossy(name: str) -> Scene:
    """Random Gaussians that mirror what is there to be mirrored; float64."""
    if not name.startswith("traced"):
        return test_deferred.glossy(size=3, count=6)
    scene = test_traced.glossy()
    if name == "traced discs":
        primary, around = (test_traced.flattened(part) for part in (scene.primary, scene.surroundings))
        return replace(scene, primary=primary, surroundings=around)
    return scene


def tinted(gaussians: Gaussians, *logits: float) -> Gaussians:
    """The Gaussians with these logits of red, green and blue, or else with random ones."""
    count = len(gaussians)
    random = torch.randn(3, count, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    values = torch.tensor(logits, dtype=torch.float64)[:, None].expand(3, count) if logits else random
    return with_tint(gaussians).with_tensors(dict(zip(TINT, values.unbind(0), strict=True)))


@EACH
def test_a_tint_of_zeros_is_white(name: str) -> None:
    scene, camera = glossy(name), camera_at(0.1, 0.0, 0.0)
    plain = RENDERERS[name](scene, camera)
    white = RENDERERS[name](replace(scene, primary=with_tint(scene.primary)), camera)
    torch.testing.assert_close(white.rgb, plain.rgb, atol=1e-12, rtol=0)
    assert "tint" not in plain.layers and bool((white.layers["tint"] == 1).all())


@EACH
def test_a_tint_is_a_strength_for_each_color(name: str) -> None:
    """Each channel is what it would be with that strength in place of the grey one."""
    scene, camera = glossy(name), camera_at(0.1, 0.0, 0.0)
    logits = (0.9, -0.2, -0.7)
    frame = RENDERERS[name](replace(scene, primary=tinted(scene.primary, *logits)), camera)
    for channel, logit in enumerate(logits):
        strengths = {"primary.logit_strength": scene.primary.channels["logit_strength"] + logit}
        grey = RENDERERS[name](scene.with_parameters(strengths), camera)
        torch.testing.assert_close(frame.rgb[..., channel], grey.rgb[..., channel], atol=1e-9, rtol=0)
    assert float(frame.layers["strength"].max()) > 0.1


@EACH
def test_the_image_is_composed_of_its_layers(name: str) -> None:
    scene = glossy(name)
    layers = (frame := RENDERERS[name](replace(scene, primary=tinted(scene.primary)), camera_at(0.1, 0.0, 0.0))).layers
    share = layers["strength"][..., None] * layers["tint"]
    seen = layers["strength"] > 0.01
    found = ((1 - share) * layers["base"] + share * layers["reflection"])[seen]
    if name != "forward":  # That shades Gaussians, whose colours differ.
        torch.testing.assert_close(found, frame.rgb[seen])
    assert float((layers["tint"] - 1).abs().max()) > 0.1


@EACH
def test_what_all_three_have_in_common_changes_nothing(name: str) -> None:
    scene, camera = glossy(name), camera_at(0.1, 0.0, 0.0)
    one, other = tinted(scene.primary, 1.0, 0.0, -0.5), tinted(scene.primary, 4.0, 3.0, 2.5)
    frames = [RENDERERS[name](replace(scene, primary=primary), camera) for primary in (one, other)]
    torch.testing.assert_close(frames[0].rgb, frames[1].rgb)


@pytest.mark.parametrize("name", ["without depth", "forward", "traced", "traced discs"])
def test_gradients_match_finite_differences(name: str) -> None:
    scene, camera = glossy(name), camera_at(0.1, 0.0, 0.0, width=12, height=9)
    scene = replace(scene, primary=tinted(scene.primary))
    names = ["primary.logit_strength", *(f"primary.{channel}" for channel in TINT), "primary.logit_opacities"]
    weights = torch.randn(9, 12, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)

    def loss(*tensors: Tensor) -> Tensor:
        learning = scene.with_parameters(dict(zip(names, tensors, strict=True)))
        return (RENDERERS[name](learning, camera).rgb * weights).sum()

    leaves = [scene.parameters()[each].clone().requires_grad_() for each in names]
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-5, rtol=1e-3, fast_mode=True)
    gradients = torch.autograd.grad(loss(*leaves), leaves)
    assert all(float(gradient.abs().max()) > 0 for gradient in gradients)


def test_pixels_that_are_not_shaded_keep_their_base() -> None:
    scene = glossy("deferred")
    scene, camera = replace(scene, primary=tinted(scene.primary)), camera_at(0.1, 0.0, 0.0)
    every = Deferred()(scene, camera)
    least = 0.5 * float(every.layers["strength"].max())
    some = Deferred(least_strength=least)(scene, camera)
    dull = every.layers["strength"] < least
    assert torch.equal(some.rgb[dull], some.layers["base"][dull]) and torch.equal(some.rgb[~dull], every.rgb[~dull])


@pytest.mark.parametrize("renderer", [Deferred(), Traced()])
def test_the_layer_is_there_when_asked_for_and_white_without_colors(renderer: Deferred | Traced) -> None:
    scene = glossy("deferred" if isinstance(renderer, Deferred) else "traced")
    asked = renderer_with(renderer, ["tint"])(scene, camera_at(0.1, 0.0, 0.0))
    assert asked.layers["tint"].unique().tolist() == [1.0] and asked.layers["tint"].shape == asked.rgb.shape
    assert "tint" not in renderer_with(renderer, ["base"])(scene, camera_at(0.1, 0.0, 0.0)).layers


def test_where_nothing_reflects_the_layer_is_white() -> None:
    strength, excess = torch.tensor([[0.0, 1e-4, 0.5]]), torch.full((1, 3, 3), -0.25)
    assert tint_layer(strength, excess)[0, :, 0].tolist() == [1.0, 1.0, 0.5]
    assert tint_layer(strength, None).shape == (1, 3, 3)


def test_strengths_stay_between_nothing_and_everything() -> None:
    gaussians = tinted(glossy("deferred").primary, 60.0, 0.0, -60.0)
    for logit in (30.0, 0.0, -30.0):
        logits = torch.full((len(gaussians),), logit, dtype=torch.float64)
        excess = excess_strengths(gaussians.with_tensors({"logit_strength": logits}))
        strengths = torch.sigmoid(logits)[:, None] + excess
        assert float(excess.abs().max()) > 0 and bool(((strengths >= 0) & (strengths <= 1)).all())
