"""Options that change a scene before it is rendered."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from glassplat.data.errors import InputError, input_checked
from glassplat.data.ranges import Finite, PaneLabel, Share

if TYPE_CHECKING:
    from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class SceneEdits:
    """Changes to panes and surroundings; the run itself stays as it is. Pane labels are those of the masks.

    Attributes:
        remove_glass: no reflections at all, only what is behind the panes.
        as_mirror: labels of panes that become perfect mirrors.
        reflectance: pane label and its reflectance at normal incidence, 0 to 1; `--reflectance 1 0.5 2 0`.
        tilt: pane label and two angles in degrees, about the pane's first and second side; `--tilt 1 10 0`.
        shift: pane label and a distance along the pane's normal in world units, those of the capture's poses;
            the normal is in results.json, and a negative distance goes the other way; `--shift 1 0.05`.
        surroundings: panorama (.exr or .png, equirectangular, z up) that glossy things mirror instead of their own.
    """

    remove_glass: bool = False
    as_mirror: tuple[PaneLabel, ...] = ()
    reflectance: dict[PaneLabel, Share] = field(default_factory=dict)
    tilt: dict[PaneLabel, tuple[Finite, Finite]] = field(default_factory=dict)
    shift: dict[PaneLabel, Finite] = field(default_factory=dict)
    surroundings: Path | None = None

    def applied(self, scene: Scene) -> Scene:
        """The edited scene.

        Raises:
            InputError: there are no panes, no pane has a label, a value is out of range, edits contradict, or the
                panorama cannot be read or nothing mirrors it.
        """
        from glassplat.scene.plane_edits import as_mirrors, shifted, tilted, with_reflectance, without_glass

        if self.surroundings is not None:
            scene = in_surroundings(scene, self.surroundings)
        if replace(self, surroundings=None) == SceneEdits():
            return scene
        self._check(scene)
        with input_checked():
            for label, reflectance in self.reflectance.items():
                scene = with_reflectance(scene, label, reflectance)
            for label, angles in self.tilt.items():
                scene = tilted(scene, label, *angles)
            for label, distance in self.shift.items():
                scene = shifted(scene, label, distance)
            scene = as_mirrors(scene, self.as_mirror)
        return without_glass(scene) if self.remove_glass else scene

    def _check(self, scene: Scene) -> None:
        if not len(scene.planes):
            raise InputError("the run has no panes to edit; train it with `glassplat train planar` and pane masks")
        if self.remove_glass and replace(self, surroundings=None) != SceneEdits(remove_glass=True):
            raise InputError("--remove-glass leaves no pane to edit; give it without the other edits")
        twice = sorted(set(self.as_mirror) & set(self.reflectance))
        if twice:
            raise InputError(f"panes {twice} have a --reflectance and are --as-mirror; give one of the two")


def in_surroundings(scene: Scene, panorama: Path) -> Scene:
    """The scene with another environment, as finely divided as its own.

    Raises:
        InputError: the scene mirrors no environment, or the panorama cannot be read.
    """
    from glassplat.files.environment_image import read_equirect
    from glassplat.render.environment import environment_from_equirect

    if scene.environment.is_empty:
        raise InputError("nothing in the run mirrors its surroundings; train it with `glassplat train deferred`")
    try:
        environment = environment_from_equirect(read_equirect(panorama), scene.environment.size)
    except (FileNotFoundError, ValueError) as error:
        raise InputError(str(error)) from error
    raw = environment.raw.to(scene.environment.raw)
    return replace(scene, environment=replace(scene.environment, raw=raw))
