"""What a frame's layers make of its pane: a photograph without the reflection, and the pane as a mirror."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.render.choices import Blend
from glassplat.render.frame import Frame
from glassplat.render.glazing import curves
from glassplat.scene.exposure import Exposures

TRUSTED_STRENGTH, DISTRUSTED_STRENGTH = 0.35, 0.65
"""Between these shares of reflected light, the photograph gives way to the rendered transmission."""
CLIPPING_BEGINS = 0.96
"""From this sRGB value on, a photograph's brightest channel says less and less about the light."""
FAINT_LIGHT, PLAIN_LIGHT = 0.01, 0.05
"""Reflected light, of 1, that a clipped pixel may hide without harm, and that it may not."""
TRUSTED_PART, DISTRUSTED_PART = 0.3, 0.8
"""Between these parts of the photographed light, taking the reflection off leaves less and less that is certain."""
TRUST_WINDOW = 5
"""Pixels over which trust is averaged, so that noise does not switch it from pixel to pixel."""
DARKEST = 1e-3


def dereflected_photo(
    frame: Frame, photo: Tensor, blend: Blend, *, exposures: Exposures | None = None, name: str = ""
) -> Tensor:
    """The photograph [H, W, 3] uint8 with the reflection taken off where the frame shows a pane.

    Solves Eq. 1, C = (1 - R) C_t + R C_r, for C_t from the photographed C and the rendered R and R C_r, so
    that detail the scene does not hold survives. Of panes seen through one another it takes off all: C_t is the image
    without panes, and R and R C_r are what they add together. The rendered C_t takes over smoothly where most of the
    light is reflected, and where the photograph is clipped and the reflection can be seen; there, the
    difference would show the errors of the rendered reflection instead. Pixels without a pane are the
    photograph's, bit for bit.

    Args:
        frame: a view rendered by `planar`, with `without_panes` and `share`; on the CPU. Where
            it has the layer `photographed`, who took the photograph is taken off as well.
        photo: [H, W, 3] uint8, of that view.
        blend: the space in which the run holds Eq. 1.
        exposures: of the photographs of the run; it is in the scene's colours that layers add up.
        name: of this photograph among them.

    Raises:
        ValueError: photograph and frame differ in size.
    """
    if photo.shape != frame.rgb.shape:
        raise ValueError(f"the photograph is {list(photo.shape)}, the frame {list(frame.rgb.shape)}; expected one size")
    decode, encode = curves(blend)
    without_panes, share = frame.layers["without_panes"], frame.layers["share"][..., None]
    exposures = exposures or Exposures.neutral()
    photographed = photo.to(torch.float32) / 255
    # Clipping is the camera's, all else the scene's.
    clipped = photographed
    photographed = exposures.undone(photographed, name).clamp(0, 1)
    light, reflected = decode(photographed), decode(frame.photographed) - (1 - share) * decode(without_panes)
    # The trust is almost zero before this division would blow up noise.
    solved = (light - reflected) / (1 - share).clamp(min=1 - DISTRUSTED_STRENGTH)
    rendered = decode(without_panes.clamp(0, 1))
    trust = _trust(clipped, light, reflected, share[..., 0])
    behind = rendered + trust[..., None] * (solved - rendered)
    colors = exposures.applied(encode(behind.clamp(0, 1)), name)
    pixels = torch.round(colors.clamp(0, 1) * 255).to(torch.uint8)
    return torch.where(share > 0, pixels, photo)


def as_mirror_image(frame: Frame, blend: Blend) -> Tensor:
    """The image [H, W, 3] that the frame would be if its panes reflected everything (R0 = 1), sRGB.

    Costs no rendering: the reflection layer already holds what the panes mirror, at full strength.

    Args:
        frame: a view rendered by `planar`, with all its layers.
        blend: the space in which the run holds Eq. 1.
    """
    decode, encode = curves(blend)
    layers = frame.layers
    share = (layers["mask"] * (layers["strength"] > 0))[..., None]
    behind, mirrored = decode(layers["transmission"]), decode(layers["reflection"])
    return encode(behind + share * (mirrored - behind))


def _trust(photographed: Tensor, light: Tensor, reflected: Tensor, strength: Tensor) -> Tensor:
    """How far [H, W] the photograph is believed over the rendered transmission, in [0, 1]."""
    overwhelmed = _smooth_step(strength, TRUSTED_STRENGTH, DISTRUSTED_STRENGTH)
    clipped = _smooth_step(photographed.amax(-1), CLIPPING_BEGINS, 1.0)
    visible = _smooth_step(reflected.amax(-1), FAINT_LIGHT, PLAIN_LIGHT)
    # A small difference of two large amounts of light is mostly the error of the rendered one.
    drowned = _smooth_step(reflected.mean(-1) / (light.mean(-1) + DARKEST), TRUSTED_PART, DISTRUSTED_PART)
    trust = (1 - overwhelmed) * (1 - clipped * visible) * (1 - drowned)
    return torch.nn.functional.avg_pool2d(
        trust[None], TRUST_WINDOW, stride=1, padding=TRUST_WINDOW // 2, count_include_pad=False
    )[0]


def _smooth_step(values: Tensor, low: float, high: float) -> Tensor:
    """0 up to `low`, 1 from `high` on, and a curve without kinks between."""
    share = ((values - low) / (high - low)).clamp(0, 1)
    return share * share * (3 - 2 * share)
