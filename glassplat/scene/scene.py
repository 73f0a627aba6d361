"""The scene that renderers draw, including its environment, and edits of panes and their glass."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from glassplat.scene import check_tensor_names, logit
from glassplat.scene.camera import quat_from_rotation, quat_product, rotation_from_quat
from glassplat.scene.corrections import Direction, Exposures, PoseCorrections
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import PANE_TENSORS, Planes, name_labels, nearest_panes

FACES = 6
"""Faces of a cube map."""
NOISE = 5.0
"""Amplitude of the initial logits of an environment."""


@dataclass(frozen=True, eq=False)
class Environment:
    """Light from infinitely far away, one colour for each direction.

    The colour in a world direction d is sigmoid(bilinear(raw, d)): the sigmoid comes after the lookup. Faces and their
    axes are those of `glassplat.kernels.environment.cube_lookup`.

    Attributes:
        raw: [6, S, S, 3] logits of sRGB colour; S = 0 for a scene without an environment.
        region: centre and radius, world units, of the sphere that holds all that mirrors it; None for everywhere.
    """

    raw: Tensor
    region: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.raw.shape)
        if len(shape) != 4 or shape[0] != FACES or shape[1] != shape[2] or shape[3] != 3:
            raise ValueError(
                f"raw has shape {shape}; expected (6, S, S, 3), six square faces with three colour channels each"
            )

    def __repr__(self) -> str:
        return f"Environment({FACES} faces of {self.size}x{self.size})"

    @property
    def size(self) -> int:
        """Texels along the side of a face, S."""
        return self.raw.shape[1]

    @property
    def is_empty(self) -> bool:
        """Return whether there is no environment."""
        return self.size == 0

    def surrounds(self, means: Tensor) -> Tensor:
        """[N] bool: centres [N, 3] inside the region; all if there is none."""
        if self.region is None:
            return torch.ones(len(means), dtype=torch.bool, device=means.device)
        *center, radius = self.region
        return (means - means.new_tensor(center)).norm(dim=1) <= radius

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {"raw": self.raw}

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> Environment:
        """The environment with its tensors replaced by name."""
        return replace(self, **check_tensor_names(tensors, self.tensors(), "environments"))

    def to(self, device: torch.device | torch.dtype | str) -> Environment:
        """The same environment on another device, or in another precision."""
        return replace(self, raw=self.raw.to(device))

    @staticmethod
    def empty() -> Environment:
        """No environment."""
        return Environment(torch.zeros(FACES, 0, 0, 3, dtype=torch.float32))

    @staticmethod
    def random(size: int, *, generator: torch.Generator) -> Environment:
        """Initial environment: raw values uniform in [-NOISE, NOISE], on the generator's device.

        Raises:
            ValueError: the size is below 1.
        """
        if size < 1:
            raise ValueError(f"the environment's size is {size}; expected at least 1 texel along a face")
        uniform = torch.rand(FACES, size, size, 3, generator=generator, device=generator.device, dtype=torch.float32)
        return Environment((2 * uniform - 1) * NOISE)


GAUSSIAN_SETS = ("primary", "glass", "surroundings", "photographer")
OPTIONAL_SETS = GAUSSIAN_SETS[2:]
"""Sets of Gaussians that most scenes lack."""
PARTS = (*GAUSSIAN_SETS, "planes", "environment", "exposures", "poses")
"""Fields of `Scene` that hold tensors."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Primary and glass Gaussians, reflection planes, and the surroundings that glossy surfaces reflect.

    Attributes:
        primary: the scene itself, in front of the panes and behind them.
        glass: Gaussians that mark where a pane reflects; they appear in the mask only.
        planes: the panes; empty for a scene without reflection.
        extent: radius of the capture in world units; learning rates and distances scale with it.
        environment: distant light reflected by glossy surfaces; empty for most methods.
        surroundings: Gaussians visible only in reflections of glossy surfaces (EnvGS); empty for most methods.
        photographer: Gaussians in the photographer's frame (`world_from_photographer`), visible only in panes; empty
            for most methods.
        up: unit up direction of the photographer; None if they tilt with the camera.
        exposures: learned exposures of the training photographs; empty if not learned.
        poses: learned pose corrections of the training photographs; empty if not learned.
    """

    primary: Gaussians
    extent: float
    glass: Gaussians = field(default_factory=lambda: Gaussians.empty(channels=("logit_mark",)))
    planes: Planes = field(default_factory=Planes.empty)
    environment: Environment = field(default_factory=Environment.empty)
    surroundings: Gaussians = field(default_factory=Gaussians.empty)
    photographer: Gaussians = field(default_factory=Gaussians.empty)
    up: Direction | None = None
    exposures: Exposures = field(default_factory=Exposures.neutral)
    poses: PoseCorrections = field(default_factory=PoseCorrections.neutral)

    def __post_init__(self) -> None:
        if not 0 < self.extent < math.inf:
            raise ValueError(f"the extent is {self.extent}; expected the radius of the capture, a length above 0")

    def __repr__(self) -> str:
        sets = (f"{name}={gaussians}" for name, gaussians in self.gaussian_sets().items())
        return f"Scene({', '.join(sets)}, planes={self.planes}, extent={self.extent:.4g})"

    def gaussian_sets(self) -> dict[str, Gaussians]:
        """The sets of Gaussians by name, with surroundings and photographer if present."""
        sets = {"primary": self.primary, "glass": self.glass}
        return sets | {name: getattr(self, name) for name in OPTIONAL_SETS if len(getattr(self, name))}

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians in all sets."""
        return sum(map(len, self.gaussian_sets().values()))

    def tensors(self) -> dict[str, Tensor]:
        """Every tensor by dotted name (`primary.means`, `planes.tangents`, ...).

        Includes the environment (`environment.raw`), exposures and poses if present.
        """
        parts: dict[str, Any] = {**self.gaussian_sets(), "planes": self.planes}
        parts |= {} if self.environment.is_empty else {"environment": self.environment}
        parts |= {name: getattr(self, name) for name in ("poses", "exposures") if len(getattr(self, name))}
        return {f"{part}.{name}": t for part, held in parts.items() for name, t in held.tensors().items()}

    def parameters(self) -> dict[str, Tensor]:
        """Every trainable tensor by dotted name: all but those that define the rectangles of panes."""
        fixed = {f"planes.{name}" for name in self.planes.tensors().keys() - set(PANE_TENSORS)}
        return {name: tensor for name, tensor in self.tensors().items() if name not in fixed}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Scene:
        """The scene with some tensors replaced by dotted name."""
        parts: dict[str, dict[str, Tensor]] = {name: {} for name in PARTS}
        for dotted, tensor in parameters.items():
            part, _, name = dotted.partition(".")
            if part not in parts:
                raise ValueError(f"unknown scene part {part!r} in {dotted!r}; expected one of {sorted(parts)}")
            parts[part][name] = tensor
        changed: dict[str, Any] = {name: getattr(self, name).with_tensors(parts[name]) for name in PARTS if parts[name]}
        return replace(self, **changed)

    def with_gaussians(self, part: str, gaussians: Gaussians) -> Scene:
        """The scene with one set of Gaussians replaced."""
        if part not in GAUSSIAN_SETS:
            raise ValueError(f"unknown set of Gaussians {part!r}; expected one of {sorted(GAUSSIAN_SETS)}")
        changed: dict[str, Any] = {part: gaussians}
        return replace(self, **changed)

    def to(self, device: torch.device | torch.dtype | str) -> Scene:
        """The same scene on another device, or in another precision."""
        moved: dict[str, Any] = {name: getattr(self, name).to(device) for name in PARTS}
        return replace(self, **moved)


LARGEST_LOGIT = 50.0
"""Its sigmoid is 1 in both precisions; finite, so that the scene can be written."""


def scale_scene(scene: Scene, factor: float) -> Scene:
    """The scene in other units: all lengths scaled about the origin; exact for 1.

    Raises:
        ValueError: the factor is not positive and finite.
    """
    if not 0 < factor < math.inf:
        raise ValueError(f"a scene cannot be scaled by {factor}; expected a positive number")
    sets: dict[str, Any] = {}
    for name in GAUSSIAN_SETS:
        gaussians: Gaussians = getattr(scene, name)
        sizes = {"means": gaussians.means * factor, "log_scales": gaussians.log_scales + math.log(factor)}
        sets[name] = gaussians.with_tensors(sizes)
    planes, region = scene.planes, scene.environment.region
    lengths = {"centers": planes.centers * factor, "half_sizes": planes.half_sizes * factor}
    if region is not None:
        x, y, z, radius = (factor * length for length in region)
        sets["environment"] = replace(scene.environment, region=(x, y, z, radius))
    return replace(scene, **sets, planes=planes.with_tensors(lengths), extent=factor * scene.extent)


def without_glass(scene: Scene) -> Scene:
    """The scene without panes."""
    return replace(
        scene, glass=scene.glass.select(torch.zeros(len(scene.glass), dtype=torch.bool)), planes=Planes.empty()
    )


def without_pane(scene: Scene, label: int) -> Scene:
    """The scene without one of its panes.

    Raises:
        ValueError: no pane has the label.
    """
    row = row_of_label(scene.planes, label)
    if len(scene.planes) == 1:
        return without_glass(scene)
    glass = scene.glass.select(~glass_of_pane(scene, row))
    return replace(scene, glass=glass, planes=scene.planes.select([k for k in range(len(scene.planes)) if k != row]))


def as_mirrors(scene: Scene, labels: Sequence[int]) -> Scene:
    """The scene with the panes of these labels turned into perfect mirrors.

    Raises:
        ValueError: no pane has one of the labels.
    """
    for label in labels:
        scene = with_reflectance(scene, label, 1.0)
    mirrors = {*scene.planes.mirrors, *labels}
    return replace(scene, planes=replace(scene.planes, mirrors=tuple(k for k in scene.planes.labels if k in mirrors)))


def with_reflectance(scene: Scene, label: int, base_reflectance: float) -> Scene:
    """The scene with another reflectance R0 of a pane, at normal incidence; Fresnel's laws add to it at an angle.

    Below 1, a mirror becomes an ordinary pane, whose reflectance is trainable.

    Raises:
        ValueError: no pane has the label, or the reflectance is not in [0, 1].
    """
    if not 0 <= base_reflectance <= 1:
        raise ValueError(f"a reflectance of {base_reflectance} for pane {label}; expected a number in [0, 1]")
    row = row_of_label(scene.planes, label)
    logits = scene.planes.logit_reflectances.clone()
    logits[row] = torch.logit(logits.new_tensor(base_reflectance)).clamp(-LARGEST_LOGIT, LARGEST_LOGIT)
    mirrors = tuple(k for k in scene.planes.mirrors if k != label or base_reflectance == 1)
    return replace(scene, planes=replace(scene.planes, logit_reflectances=logits, mirrors=mirrors))


def tilt_pane(
    scene: Scene, label: int, about_tangent: float, about_bitangent: float, *, owned: Tensor | None = None
) -> Scene:
    """The scene with a pane and its glass tilted about the rectangle's centre; exact for zero angles.

    Args:
        scene: what to edit; it is left as it is.
        label: which pane.
        about_tangent: degrees about the rectangle's first side, right-handed.
        about_bitangent: degrees about its second side. Two angles together are one rotation vector.
        owned: [N] bool, the pane's glass; if None, what is nearest to it.

    Raises:
        ValueError: no pane has the label, or an angle is not finite.
    """
    row = row_of_label(scene.planes, label)
    _check_finite(label, about_tangent, about_bitangent)
    about_tangent, about_bitangent = float(about_tangent), float(about_bitangent)
    angle = math.radians(math.hypot(about_tangent, about_bitangent))
    if angle == 0:
        return scene
    tangent, bitangent = (axes[row] for axes in scene.planes.axes())
    axis = torch.nn.functional.normalize(about_tangent * tangent + about_bitangent * bitangent, dim=0)
    turn = torch.cat([axis.new_tensor([math.cos(angle / 2)]), math.sin(angle / 2) * axis])
    return _rotate_pane(scene, row, turn, glass_of_pane(scene, row) if owned is None else owned)


def shift_pane(scene: Scene, label: int, distance: float, *, owned: Tensor | None = None) -> Scene:
    """The scene with a pane and its glass shifted along the pane's normal; exact for zero.

    Args:
        scene: what to edit; it is left as it is.
        label: which pane.
        distance: world units, positive along the normal.
        owned: [N] bool, the pane's glass; if None, what is nearest to it.

    Raises:
        ValueError: no pane has the label, or the distance is not finite.
    """
    row = row_of_label(scene.planes, label)
    _check_finite(label, distance)
    if distance == 0:
        return scene
    owned = glass_of_pane(scene, row) if owned is None else owned
    return _translate_pane(scene, row, distance * scene.planes.normals[row], owned)


class PaneMove(NamedTuple):
    """Movement of a pane: a rotation about its centre, then a translation, in world axes and units.

    label: label of the pane. turn: quaternion `wxyz`, of any length. step: translation of the centre.
    """

    label: int
    turn: tuple[float, ...]
    step: tuple[float, ...]


def move_panes(scene: Scene, moves: Sequence[PaneMove]) -> Scene:
    """The scene with panes and their glass rotated, then translated; exact for identity.

    Each glass Gaussian belongs to the nearest pane before the movements.

    Args:
        scene: what to edit; it is left as it is.
        moves: movements, applied one after the other.

    Raises:
        ValueError: no pane has a label, a number is not finite, or a quaternion has no length.
    """
    rows = [row_of_label(scene.planes, label) for label, _, _ in moves]
    owned = {row: glass_of_pane(scene, row) for row in rows}
    for row, (label, turn, step) in zip(rows, moves, strict=True):
        _check_finite(label, *turn, *step)
        if not any(turn):
            raise ValueError(f"pane {label} cannot be turned by a quaternion of no length; expected w, x, y, z")
        if any(turn[1:]):
            quat = torch.nn.functional.normalize(scene.planes.centers.new_tensor(turn), dim=0)
            scene = _rotate_pane(scene, row, quat, owned[row])
        if any(step):
            scene = _translate_pane(scene, row, scene.planes.centers.new_tensor(step), owned[row])
    return scene


def glass_of_pane(scene: Scene, row: int) -> Tensor:
    """[N] bool: glass Gaussians that are nearest to this pane's rectangle."""
    return nearest_panes(scene.glass.means, scene.planes) == row


def row_of_label(planes: Planes, label: int) -> int:
    """The position of the pane with a label.

    Raises:
        ValueError: there is none; the message lists the known labels.
    """
    if label not in planes.labels:
        known_labels = f"the panes are {name_labels(planes.labels)}" if len(planes) else "it has no panes"
        raise ValueError(f"the scene has no pane {label!r}; {known_labels}")
    return planes.labels.index(label)


def _rotate_pane(scene: Scene, row: int, quat: Tensor, owned: Tensor) -> Scene:
    """The scene with a pane and its glass [N] bool rotated about its centre by a unit quaternion [4]."""
    rotation = rotation_from_quat(quat)
    planes = scene.planes
    rotated = {name: _rotate_row(getattr(planes, name), row, rotation) for name in ("raw_normals", "tangents")}
    glass, of_pane = scene.glass, owned[:, None]
    center = planes.centers[row].to(glass.means)
    means = (glass.means - center) @ rotation.to(glass.means).T + center
    quats = quat_product(quat.to(glass.quats).expand_as(glass.quats), glass.quats)
    moved = {"means": torch.where(of_pane, means, glass.means), "quats": torch.where(of_pane, quats, glass.quats)}
    return replace(scene, glass=glass.with_tensors(moved), planes=planes.with_tensors(rotated))


def _translate_pane(scene: Scene, row: int, step: Tensor, owned: Tensor) -> Scene:
    """The scene with a pane and its glass [N] bool translated by a step [3]."""
    centers = scene.planes.centers.clone()
    centers[row] += step
    means = scene.glass.means
    moved = torch.where(owned[:, None], means + step.to(means), means)
    planes = scene.planes.with_tensors({"centers": centers})
    return replace(scene, glass=scene.glass.with_tensors({"means": moved}), planes=planes)


def _rotate_row(vectors: Tensor, row: int, rotation: Tensor) -> Tensor:
    """The vectors [K, 3] with one of them rotated."""
    rotated = vectors.clone()
    rotated[row] = rotation @ vectors[row]
    return rotated


def _check_finite(label: int, *numbers: float) -> None:
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"pane {label} cannot be moved by {numbers}; expected finite numbers")


OVERLAP = 0.7
"""Standard deviation of a glass Gaussian, in distances between neighbours; together, they form an even sheet."""
THICKNESS = 0.05
"""Standard deviation along the normal, as a share of that in the plane."""
COVERING_OPACITY, COVERING_MARK, COVERING_OVERLAP = 0.99, 0.9999, 1.2
"""The same for untrained panes, without gaps through which a mirror would transmit."""

MARK = 0.99
"""Mark m of untrained glass; the paper's 1 has no finite logit."""


def glass_gaussians(planes: Planes, *, count: int = 1000, seed: int = 0, opacity: float = 0.5) -> Gaussians:
    """Glass Gaussians on every pane's rectangle, on the device and of the type of its centre.

    Positions are a scrambled Sobol sequence, to avoid holes. At the default opacity, the rendered mask is initially
    about 0.8, and training removes glass where the rectangle is larger than the pane.

    Args:
        planes: the panes.
        count: number of Gaussians on each pane.
        seed: random seed of the positions.
        opacity: opacity of each Gaussian, in (0, 1).
    """
    panes = [_pane_discs(planes, index, count=count, seed=seed) for index in range(len(planes))]
    if not panes:
        return Gaussians.empty(channels=("logit_mark",))
    means, quats, log_scales = (torch.cat(tensors) for tensors in zip(*panes, strict=True))
    number = len(means)
    glass = Gaussians(
        means=means,
        quats=quats,
        log_scales=log_scales,
        logit_opacities=torch.full((number,), logit(opacity), dtype=torch.float32),
        sh=torch.zeros(number, 0, 3, dtype=torch.float32),
        channels={"logit_mark": torch.full((number,), logit(MARK), dtype=torch.float32)},
    )
    return glass.with_tensors({name: tensor.to(planes.centers) for name, tensor in glass.tensors().items()})


def covering_glass(planes: Planes) -> Gaussians:
    """Glass Gaussians for untrained panes: they cover every rectangle with a mask of almost 1."""
    glass = glass_gaussians(planes, opacity=COVERING_OPACITY)
    wider = glass.log_scales + math.log(COVERING_OVERLAP / OVERLAP)
    marks = torch.full_like(glass.channels["logit_mark"], logit(COVERING_MARK))
    return glass.with_tensors({"log_scales": wider, "logit_mark": marks})


def with_pane(scene: Scene, pane: Planes) -> Scene:
    """The scene with an additional pane, evenly covered with glass, on the device and in the precision of the scene.

    Args:
        scene: any scene; Gaussians without a reflection intensity get one of 1.
        pane: a single pane.

    Raises:
        ValueError: the scene has a pane of that label.
    """
    if set(pane.labels) & set(scene.planes.labels):
        raise ValueError(f"the scene has a pane {pane.labels[0]} already; its panes are {list(scene.planes.labels)}")
    pane = pane.with_tensors({name: tensor.to(scene.primary.means) for name, tensor in pane.tensors().items()})
    glass = covering_glass(pane)
    return replace(
        scene,
        primary=with_intensity(scene.primary),
        planes=scene.planes.concat(pane) if len(scene.planes) else pane,
        glass=scene.glass.concat(glass) if len(scene.glass) else glass,
    )


def with_intensity(gaussians: Gaussians) -> Gaussians:
    """The Gaussians with a reflection intensity of 1, unless they have one."""
    if "log_intensity" in gaussians.channels:
        return gaussians
    return replace(gaussians, channels={**gaussians.channels, "log_intensity": torch.zeros_like(gaussians.means[:, 0])})


def _pane_discs(planes: Planes, index: int, *, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Means [M, 3], quats [M, 4] and log scales [M, 3] of the discs on one pane."""
    half = planes.half_sizes[index].detach().cpu()
    samples = SobolEngine(dimension=2, scramble=True, seed=seed + index).draw(count, dtype=torch.float32)
    tangent, bitangent = (axis[index].detach().cpu() for axis in planes.axes())
    in_plane = (2 * samples - 1) * half
    means = planes.centers[index].detach().cpu() + in_plane @ torch.stack([tangent, bitangent])

    frame = torch.stack([tangent, bitangent, planes.normals[index].detach().cpu()], dim=1)
    quat = quat_from_rotation(frame).float()
    spacing = OVERLAP * math.sqrt(float(4 * half.prod()) / count)
    log_scales = torch.tensor([spacing, spacing, THICKNESS * spacing], dtype=torch.float32).log()
    return means, quat.repeat(len(means), 1), log_scales.repeat(len(means), 1)
