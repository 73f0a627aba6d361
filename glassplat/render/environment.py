"""Environments as panoramas and back, and turned with the world.

Panoramas are equirectangular images [H, 2H, 3], sRGB, z up, as seen from inside: row 0 is +z, the middle column looks
along +x, +y is left of it by a quarter of the width, -y right of it, and -x at both ends. Longitude, from +x towards
+y, grows to the left, as in any photograph taken from inside.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from glassplat.kernels.environment import cube_lookup
from glassplat.scene.scene import FACES, Environment

COLOR_MARGIN = 1e-3
"""Colours are kept this far from 0 and 1, whose logits are infinite; eight bits do not tell the difference."""


def equirect_from_environment(environment: Environment, height: int) -> Tensor:
    """The environment as a panorama [H, 2H, 3] sRGB in (0, 1); each pixel is the mean of what it covers.

    Differentiable in the environment.

    Args:
        environment: not empty.
        height: rows of the panorama; 2 S shows every texel.

    Raises:
        ValueError: the environment is empty, or the height is below 1.
    """
    _check_lit(environment)
    if height < 1:
        raise ValueError(f"the panorama's height is {height}; expected at least 1 row")
    samples = max(1, math.ceil(2 * environment.size / height))
    directions = panorama_directions(samples * height).to(environment.raw)
    colors = torch.sigmoid(cube_lookup(environment.raw, directions))
    return colors.reshape(height, samples, 2 * height, samples, 3).mean(dim=(1, 3))


def environment_from_equirect(image: Tensor, size: int) -> Environment:
    """The environment that a panorama shows; each texel is the mean of what it covers.

    Args:
        image: [H, 2H, 3] sRGB in [0, 1]; values within `COLOR_MARGIN` of 0 and 1 are held there.
        size: texels along the side of a face.

    Raises:
        ValueError: the image is not twice as wide as high or not finite floating point, or the size is below 1.
    """
    height = image.shape[0]
    if image.ndim != 3 or height < 1 or tuple(image.shape) != (height, 2 * height, 3):
        raise ValueError(f"the panorama has shape {tuple(image.shape)}; expected (H, 2 H, 3)")
    if not image.is_floating_point() or not bool(torch.isfinite(image).all()):
        raise ValueError(
            "the panorama holds values that are not finite floating-point numbers; expected sRGB in [0, 1]"
        )
    if size < 1:
        raise ValueError(f"the environment's size is {size}; expected at least 1 texel along a face")
    samples = max(1, math.ceil(height / (2 * size)))
    fine = _looked_up(image, texel_directions(samples * size).to(image))
    colors = fine.reshape(FACES, size, samples, size, samples, 3).mean(dim=(2, 4))
    return Environment(torch.logit(colors.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)))


def rotated(environment: Environment, rotation: Tensor) -> Environment:
    """The environment of a rotated world: what was in direction d is in direction `rotation @ d`; resampled.

    The centre of its region moves along.

    Args:
        environment: may be empty.
        rotation: [3, 3] orthogonal matrix; may be a mirroring.

    Raises:
        ValueError: not an orthogonal matrix.
    """
    turn = rotation.detach().double()
    identity = torch.eye(3, dtype=turn.dtype, device=turn.device)
    if tuple(turn.shape) != (3, 3) or not torch.allclose(turn @ turn.T, identity, atol=1e-4):
        raise ValueError(f"expected a rotation matrix [3, 3] with orthonormal rows, got {rotation.tolist()}")
    region = environment.region
    if region is not None:
        x, y, z = (turn @ turn.new_tensor(region[:3])).tolist()
        region = (x, y, z, region[3])
    if environment.is_empty:
        return Environment(environment.raw, region)
    # A row d of directions times R is R^T d: where the rotated direction was before.
    before = texel_directions(environment.size) @ turn.cpu()
    return Environment(cube_lookup(environment.raw, before.to(environment.raw)), region)


def resized(environment: Environment, size: int) -> Environment:
    """The environment with another number of texels; raw values are interpolated between texel centres."""
    _check_lit(environment)
    return replace(environment, raw=cube_lookup(environment.raw, texel_directions(size).to(environment.raw)))


def panorama_directions(height: int) -> Tensor:
    """Unit directions [H, 2H, 3] float64 of the pixel centres of a panorama."""
    latitudes = math.pi * (0.5 - (torch.arange(height, dtype=torch.float64) + 0.5) / height)
    longitudes = 2 * math.pi * (0.5 - (torch.arange(2 * height, dtype=torch.float64) + 0.5) / (2 * height))
    z, across = latitudes.sin()[:, None], latitudes.cos()[:, None]
    return torch.stack([across * longitudes.cos(), across * longitudes.sin(), z.expand(-1, 2 * height)], dim=-1)


def texel_directions(size: int) -> Tensor:
    """Directions [6, S, S, 3] float64 of the texel centres of a cube map, faces and axes as in `cube_lookup`."""
    centers = (2 * torch.arange(size, dtype=torch.float64) + 1) / size - 1
    directions = torch.empty(FACES, size, size, 3, dtype=torch.float64)
    for face in range(FACES):
        axis = face // 2
        directions[face, ..., axis] = 1 - 2 * (face % 2)
        directions[face, ..., (axis + 1) % 3] = centers
        directions[face, ..., (axis + 2) % 3] = centers[:, None]
    return directions


def _check_lit(environment: Environment) -> None:
    if environment.is_empty:
        raise ValueError("the scene has no environment; expected one trained with `deferred`")


def _looked_up(image: Tensor, directions: Tensor) -> Tensor:
    """The panorama in directions [..., 3], by a bilinear filter that goes on across its ends and poles."""
    height, width = image.shape[:2]
    # Beyond a pole the meridian on the other side begins.
    rows = torch.cat([image[:1].roll(height, dims=1), image, image[-1:].roll(height, dims=1)])
    padded = torch.cat([rows[:, -1:], rows, rows[:, :1]], dim=1)
    x, y, z = directions.unbind(-1)
    column = (0.5 - torch.atan2(y, x) / (2 * math.pi)) * width + 0.5
    row = (0.5 - torch.atan2(z, torch.hypot(x, y)) / math.pi) * height + 0.5
    grid = torch.stack([2 * column / (width + 1) - 1, 2 * row / (height + 1) - 1], dim=-1).reshape(1, -1, 1, 2)
    found = grid_sample(padded.permute(2, 0, 1)[None], grid, align_corners=True, padding_mode="border")
    return found[0, :, :, 0].T.reshape(directions.shape)
