"""Sets of Gaussians, ellipsoids or discs, as raw (unactivated) tensors, and their mirror images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from glassplat.scene import check_tensor_names

DISC_SCALES = 2
"""Number of scales of a disc; ellipsoids have one more."""
SH_COEFFICIENTS = (0, 1, 4, 9, 16)
"""Possible numbers of SH coefficients: none, or those of degrees 0 to 3."""
ALL_DEGREES = -1
"""Stands for the highest that `sh` holds."""
PER_GAUSSIAN = ("means", "quats", "log_scales", "logit_opacities", "sh")


def check_rows(tensors: Mapping[str, Tensor], count: int, rows: Mapping[str, tuple[tuple[int, ...], ...]]) -> None:
    """Refuse tensors that lack `count` rows of a shape allowed by `rows`, else single numbers; `sh` only if no tensor.

    Raises:
        TypeError: something is no tensor.
        ValueError: a tensor has another shape.
    """
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor):
            raise TypeError(f"{name} is a {type(tensor).__name__}; expected a tensor (`torch.from_numpy` makes one)")
        allowed = [(count, *row) for row in rows.get(name, ((),))]
        if name != "sh" and tensor.shape not in allowed:
            expected = " or ".join(map(str, allowed))
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)}; expected {expected}, as many rows in all tensors"
            )


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N anisotropic Gaussians in world space; every tensor is a raw, trainable value.

    Attributes:
        means: [N, 3] centres, world units.
        quats: [N, 4] orientation `wxyz`, not necessarily unit; normalised where used.
        log_scales: logarithm of the standard deviation along each principal axis: [N, 3] for ellipsoids (3DGS), [N, 2]
            for discs (2DGS), whose third axis is their normal.
        logit_opacities: [N] opacity before the sigmoid.
        sh: [N, K, 3] spherical-harmonic colour coefficients, K in {0, 1, 4, 9, 16}; K = 0 for
            Gaussians without a colour of their own (glass).
        channels: named raw per-Gaussian values, each [N] (`log_intensity`, `logit_mark`, ...).
        active_sh_degree: SH degree in use; grows during training. All that `sh` holds if not given.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor
    channels: Mapping[str, Tensor] = field(default_factory=dict)
    active_sh_degree: int = ALL_DEGREES

    def __post_init__(self) -> None:
        count = len(self.means) if isinstance(self.means, Tensor) and self.means.dim() else 0
        check_rows(self.tensors(), count, {"means": ((3,),), "quats": ((4,),), "log_scales": ((2,), (3,))})
        sizes = tuple(self.sh.shape)
        if len(sizes) != 3 or sizes[0] != count or sizes[1] not in SH_COEFFICIENTS or sizes[2] != 3:
            raise ValueError(
                f"sh has shape {sizes}; expected (N, K, 3) with K one of {SH_COEFFICIENTS}, as degrees "
                f"up to 3 have them, and N = {count} as in means"
            )
        if self.active_sh_degree == ALL_DEGREES:
            object.__setattr__(self, "active_sh_degree", max(self.max_sh_degree, 0))
        if not 0 <= self.active_sh_degree <= max(self.max_sh_degree, 0):
            raise ValueError(
                f"active_sh_degree is {self.active_sh_degree}, but sh holds degrees up to {self.max_sh_degree}"
            )

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        kind = "discs" if self.are_discs else "ellipsoids"
        channels = f", {', '.join(self.channels)}" if self.channels else ""
        return f"Gaussians({len(self)} {kind}, SH degree {self.active_sh_degree}{channels}, {self.means.device})"

    @property
    def max_sh_degree(self) -> int:
        """SH degree of the stored coefficients; -1 without any."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def are_discs(self) -> bool:
        """Return whether the Gaussians are flat, with two scales (2DGS)."""
        return self.log_scales.shape[1] == DISC_SCALES

    @property
    def deviations(self) -> Tensor:
        """[N, 3] standard deviation along each axis, activated; 0 along the normal of a disc."""
        found = self.log_scales.exp()
        return torch.nn.functional.pad(found, (0, 1)) if self.are_discs else found

    def tensors(self) -> dict[str, Tensor]:
        """All per-Gaussian tensors by name, channels included."""
        return {name: getattr(self, name) for name in PER_GAUSSIAN} | dict(self.channels)

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> Gaussians:
        """The set with some tensors or channels replaced by name."""
        changed = check_tensor_names(tensors, self.tensors(), "these Gaussians")
        channels = {name: changed.pop(name, tensor) for name, tensor in self.channels.items()}
        return replace(self, **changed, channels=channels)

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians at `index` (a boolean mask [N] or integer indices)."""
        return self.with_tensors({name: tensor[index] for name, tensor in self.tensors().items()})

    def concat(self, other: Gaussians) -> Gaussians:
        """These Gaussians followed by others with the same tensors.

        Raises:
            ValueError: the others have other tensors, or some of other sizes.
        """
        mine, theirs = ({name: (*t.shape[1:],) for name, t in part.tensors().items()} for part in (self, other))
        if mine != theirs:
            raise ValueError(f"one set has columns {mine}, the other {theirs}; expected the same of both")
        tensors = other.tensors()
        return self.with_tensors({name: torch.cat([tensor, tensors[name]]) for name, tensor in self.tensors().items()})

    def to(self, device: torch.device | torch.dtype | str) -> Gaussians:
        """The same set on another device, or in another precision."""
        return self.with_tensors({name: tensor.to(device) for name, tensor in self.tensors().items()})

    @staticmethod
    def empty(sh_coefficients: int = 0, channels: tuple[str, ...] = ()) -> Gaussians:
        """An empty set."""
        return Gaussians(
            means=torch.zeros(0, 3, dtype=torch.float32),
            quats=torch.zeros(0, 4, dtype=torch.float32),
            log_scales=torch.zeros(0, 3, dtype=torch.float32),
            logit_opacities=torch.zeros(0, dtype=torch.float32),
            sh=torch.zeros(0, sh_coefficients, 3, dtype=torch.float32),
            active_sh_degree=0,
            channels={name: torch.zeros(0, dtype=torch.float32) for name in channels},
        )


@torch.no_grad()
def mirrored_gaussians(gaussians: Gaussians, center: Tensor, normal: Tensor) -> Gaussians:
    """Mirror images of the Gaussians at a plane, with the same shapes, opacities and constant colours.

    A mirrored ellipsoid is the ellipsoid rotated by 180 degrees about the normal, at the mirrored centre.
    View-dependent colour is dropped.

    Args:
        gaussians: any set.
        center: [3] a point on the plane, world units.
        normal: [3] unit normal; the sign does not matter.
    """
    distances = (gaussians.means - center) @ normal
    w, xyz = gaussians.quats[:, :1], gaussians.quats[:, 1:]
    half_turn = normal.expand_as(xyz)
    quats = torch.cat([-(half_turn * xyz).sum(-1, keepdim=True), w * half_turn + torch.linalg.cross(half_turn, xyz)], 1)
    sh = gaussians.sh.clone()
    sh[:, 1:] = 0
    means = gaussians.means - 2 * distances[:, None] * normal
    return gaussians.with_tensors({"means": means, "quats": quats, "sh": sh})


HALF_TURN_SH_SIGNS = {
    (1.0, -1.0, -1.0): (1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1),
    (-1.0, -1.0, 1.0): (1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1),
}
"""Signs of the harmonics under these sign changes of x, y and z."""


def rotate_half_turn(gaussians: Gaussians, signs: tuple[float, float, float]) -> Gaussians:
    """The Gaussians rotated by 180 degrees about the x axis, signs (1, -1, -1), or the z axis, (-1, -1, 1); exact."""
    flip = gaussians.means.new_tensor(signs)
    harmonics = gaussians.sh.new_tensor(HALF_TURN_SH_SIGNS[signs][: gaussians.sh.shape[1]])[:, None]
    quats = gaussians.quats * torch.cat([flip.new_ones(1), flip])
    return gaussians.with_tensors({"means": gaussians.means * flip, "quats": quats, "sh": gaussians.sh * harmonics})
