"""What a renderer returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from torch import Tensor

from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class ScreenPass:
    """Where the Gaussians of one scene part landed on screen, in one rasterisation pass.

    The gradients of a loss with respect to `means2d` and `probe` are the statistics that densification collects;
    ask for them with `torch.autograd.grad`.

    Attributes:
        part: name of the scene part, as in `Scene.gaussian_sets`.
        means2d: [C, N, 2] projected centres, pixels; part of the autograd graph.
        probe: [C, N, 2] that `composite` got; its gradient is how strongly single pixels pull at the centres.
        radii: [C, N, 2] half extents in pixels; 0 where not visible.
        weight: how much of what is drawn there is left in the image, of the whole pass or [C, N] of each Gaussian: 1
            but for what is seen in or through a pane.
        direct: whether it shows the Gaussians themselves, and not their mirror images.
    """

    part: str
    means2d: Tensor
    probe: Tensor
    radii: Tensor
    weight: float | Tensor = 1.0
    direct: bool = True


@dataclass(frozen=True)
class SpacePass:
    """How far away the Gaussians of one scene part were met that rays found in space, where there is no screen.

    The gradient of a loss with respect to their centres, times half of that distance, is what on a screen would be the
    gradient in normalised device coordinates (EnvGS, Section 5.1).

    Attributes:
        part: name of the scene part, as in `Scene.gaussian_sets`.
        distances: [N] at which rays met them, world units; means by how much they added to each ray.
    """

    part: str
    distances: Tensor


@dataclass(frozen=True)
class Frame:
    """A rendered view and its layers.

    Attributes:
        rgb: [H, W, 3] the image, sRGB, not clamped.
        layers: further images by name, [H, W] or [H, W, 3]; a renderer's docstring lists its own.
        direct: [N] bool, which primary Gaussians reach a pixel themselves; None where the renderer does not say.
        mirrored: [N] bool, which ones reach a pixel as mirror images; None where nothing is mirrored.
        screen: one record per rasterised part and pass of a probed frame.
        space: one record per traced part of a probed frame.
    """

    rgb: Tensor
    layers: Mapping[str, Tensor] = field(default_factory=dict)
    direct: Tensor | None = None
    mirrored: Tensor | None = None
    screen: tuple[ScreenPass, ...] = ()
    space: tuple[SpacePass, ...] = ()

    @property
    def photographed(self) -> Tensor:
        """[H, W, 3] what a photograph shows: the image, with the photographer where panes show one and it was asked."""
        return self.layers.get("photographed", self.rgb)

    @property
    def visible(self) -> Tensor | None:
        """[N] bool, which primary Gaussians reach a pixel in either way; None where the renderer does not say."""
        return self.direct if self.direct is None or self.mirrored is None else self.direct | self.mirrored


class Renderer(Protocol):
    """Anything that turns a scene and a camera into a frame."""

    def __call__(self, scene: Scene, camera: Camera, *, probed: bool = False) -> Frame:
        """Renders `scene` from `camera`; differentiable in every tensor of the scene.

        Args:
            scene: what is there.
            camera: from where it is seen.
            probed: also prepare `Frame.screen`, the statistics of densification; they make the backward pass slower.
        """
        ...

    def check(self, scene: Scene) -> None:
        """Looks whether a scene that was read from files has all that this draws.

        Raises:
            ValueError: it lacks something; says what.
        """
        ...
