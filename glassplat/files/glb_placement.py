"""Where the nodes of a glTF scene place what hangs on them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from glassplat.kernels.turned_harmonics import turned_harmonics
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.pose import quat_product, rotation_from_quat

TOLERANCE = 1e-4
LEAST_SCALE, MOST_SCALE = 1e-9, 1e9


@dataclass(frozen=True)
class Placement:
    """A similarity transform: x -> scale * rotation x + shift.

    Attributes:
        quat: [4] `wxyz`, unit, float64.
        scale: above 0.
        shift: [3] float64.
    """

    quat: Tensor = field(default_factory=lambda: torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    scale: float = 1.0
    shift: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))

    @property
    def is_identity(self) -> bool:
        """Whether it moves nothing."""
        return self.scale == 1 and not bool(self.shift.any()) and not bool(self.quat[1:].any())


def placement_of(node: Mapping[str, Any], outer: Placement, where: str) -> Placement:
    """Where a node places what hangs on it, within the placement of what it hangs on itself.

    Raises:
        ValueError: its transform is skewed, mirrored, of different scales, or of a scale that is none.
    """
    if node["matrix"] is not None:
        own = _of_matrix(torch.tensor(node["matrix"], dtype=torch.float64).reshape(4, 4).T, where)
    else:
        x, y, z, w = node["rotation"]
        own = _checked(
            torch.tensor([w, x, y, z], dtype=torch.float64),
            torch.tensor(node["scale"], dtype=torch.float64),
            torch.tensor(node["translation"], dtype=torch.float64),
            where,
        )
    shift = outer.shift + outer.scale * (rotation_from_quat(outer.quat) @ own.shift)
    return Placement(quat_product(outer.quat, own.quat), outer.scale * own.scale, shift)


def placed(gaussians: Gaussians, placement: Placement) -> Gaussians:
    """The Gaussians where a placement puts them, their harmonics turned along; the identity changes no bit."""
    if placement.is_identity:
        return gaussians
    rotation = rotation_from_quat(placement.quat)
    means = placement.scale * (gaussians.means.double() @ rotation.T) + placement.shift
    quats = quat_product(placement.quat.expand(len(gaussians), 4), gaussians.quats.double())
    return replace(
        gaussians,
        means=means.float(),
        quats=quats.float(),
        log_scales=gaussians.log_scales + math.log(placement.scale),
        sh=turned_harmonics(gaussians.sh, rotation),
    )


def _of_matrix(matrix: Tensor, where: str) -> Placement:
    linear = matrix[:3, :3]
    scale = float(linear.norm()) / math.sqrt(3)
    unit = linear / scale if scale > 0 else linear
    is_affine = torch.equal(matrix[3], torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64))
    shear = float((unit @ unit.T - torch.eye(3, dtype=torch.float64)).abs().max())
    if not is_affine or not shear < TOLERANCE or float(torch.linalg.det(unit)) < 0:
        raise ValueError(_unlike(where))
    return _checked(_quat_of(unit), torch.full((3,), scale, dtype=torch.float64), matrix[:3, 3], where)


def _checked(quat: Tensor, scales: Tensor, shift: Tensor, where: str) -> Placement:
    scale = float(scales[0])
    alike = bool(((scales - scale).abs() <= TOLERANCE * abs(scale)).all())
    if not (LEAST_SCALE <= scale <= MOST_SCALE) or not alike or not float(quat.norm()) > TOLERANCE:
        raise ValueError(_unlike(where))
    return Placement(torch.nn.functional.normalize(quat, dim=0), scale, shift)


def _unlike(where: str) -> str:
    return (
        f"{where} skews, mirrors or stretches splats; expected a turn, a shift and one scale: apply the transform first"
    )


def _quat_of(rotation: Tensor) -> Tensor:
    """A quaternion `wxyz` of a rotation: the eigenvector of Bar-Itzhack's matrix (2000), which has no special cases."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    rows = [
        [xx - yy - zz, yx + xy, zx + xz, zy - yz],
        [yx + xy, yy - xx - zz, zy + yz, xz - zx],
        [zx + xz, zy + yz, zz - xx - yy, yx - xy],
        [zy - yz, xz - zx, yx - xy, xx + yy + zz],
    ]
    vectors = torch.linalg.eigh(torch.tensor(rows, dtype=torch.float64)).eigenvectors
    x, y, z, w = vectors[:, -1].tolist()
    return torch.tensor([w, x, y, z], dtype=torch.float64)
