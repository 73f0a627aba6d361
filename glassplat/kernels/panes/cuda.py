"""Panes on the GPU: ray hits, blending, derivatives of the blend by its layers, and edges shared by the layers.

Shared edges are summed by one block per cell and channel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, kernel
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.images import color_space_maths
from glassplat.kernels.maths.pane import DARKEST, build_blend_channel, pane_maths, weighted_edges
from glassplat.kernels.panes.cpu import CHANNELS, conflict_count
from glassplat.kernels.records import DAZZLING, REAL_OF, TILE, PaneHits

PIXELS = TILE * TILE
SHORTEST = 1e-12
"""Lower bound of a vector's length in its normalisation, as in PyTorch."""


def pane_hits(
    inputs: Sequence[Tensor], width: int, height: int, mask: Tensor | None, beyond: PaneHits | None
) -> PaneHits:
    """As `glassplat.kernels.panes.cpu.pane_hits`."""
    centers = inputs[0]
    count, real = centers.shape[0], REAL_OF[centers.dtype]
    rows, columns = -(-height // TILE), -(-width // TILE)
    index = torch.empty(height, width, dtype=torch.int32, device=centers.device)
    depth = centers.new_empty(height, width)
    tiles = torch.zeros(count, rows, columns, dtype=torch.bool, device=centers.device)
    extents = torch.zeros(count, 4, dtype=torch.int32, device=centers.device)
    before = (None, None) if beyond is None else (beyond.pane, beyond.depth)
    pane_hits_forward(real)(rows * columns, PIXELS, *inputs, mask, *before, index, depth, tiles, extents)
    windows = centers.new_empty(count, 4)
    pane_windows_kernel(real).over(count, extents, width, height, windows)
    return PaneHits(index, depth, tiles, windows)


def panes_in_camera(
    centers: Tensor, raw_normals: Tensor, tangents: Tensor, cam_from_world: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Centres [K, 3], unit normals [K, 3] and axes [K, 2, 3] in the camera frame."""
    found = torch.empty_like(centers), torch.empty_like(centers), centers.new_empty(len(centers), 2, 3)
    rectangles_in_camera(REAL_OF[centers.dtype])(1, 1, centers, raw_normals, tangents, cam_from_world, *found)
    return found


def mirrored_views(centers: Tensor, raw_normals: Tensor, cam_from_world: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Poses [K, 4, 4], normals in the camera frame [K, 3] and half spaces [K, 4]."""
    count = len(centers)
    found = centers.new_empty(count, 4, 4), centers.new_empty(count, 3), centers.new_empty(count, 4)
    mirrored_views_forward(REAL_OF[centers.dtype])(1, 1, centers, raw_normals, cam_from_world, *found)
    return found


def mirrored_views_gradients(
    centers: Tensor, raw_normals: Tensor, cam_from_world: Tensor, v_poses: Tensor, v_normals: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of the three inputs of `mirrored_views`."""
    found = torch.empty_like(centers), torch.empty_like(raw_normals), torch.empty_like(cam_from_world)
    mirrored_views_backward(REAL_OF[centers.dtype])(
        1, 1, centers, raw_normals, cam_from_world, v_poses, v_normals, *found
    )
    return found


def vector_maths(real: type) -> tuple[Scalar, Scalar]:
    """Builds the normalisation of a vector, with its inverse length, and the rotation of a vector by a pose."""
    least, one = real(SHORTEST), real(1.0)

    @inlined
    def unit(x, y, z):
        inverse = one / max(math.sqrt(x * x + y * y + z * z), least)
        return x * inverse, y * inverse, z * inverse, inverse

    @inlined
    def rotate(pose, x, y, z):
        return (
            pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z,
            pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z,
            pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z,
        )

    return unit, rotate


@cache
def rectangles_in_camera(real: type) -> Kernel:
    """Fills all rectangles in one thread, because there are few."""
    unit, rotate = vector_maths(real)

    @kernel("panes_in_camera", real, "real2 real2 real2 real2 real2 real2 real3")
    def fill(centers, raw_normals, tangents, pose, placed, facing, axes):
        for k in range(centers.shape[0]):
            c_x, c_y, c_z = rotate(pose, centers[k, 0], centers[k, 1], centers[k, 2])
            placed[k, 0], placed[k, 1], placed[k, 2] = c_x + pose[0, 3], c_y + pose[1, 3], c_z + pose[2, 3]
            n_x, n_y, n_z, _ = unit(raw_normals[k, 0], raw_normals[k, 1], raw_normals[k, 2])
            facing[k, 0], facing[k, 1], facing[k, 2] = rotate(pose, n_x, n_y, n_z)
            t_x, t_y, t_z = tangents[k, 0], tangents[k, 1], tangents[k, 2]
            along = t_x * n_x + t_y * n_y + t_z * n_z
            t_x, t_y, t_z, _ = unit(t_x - along * n_x, t_y - along * n_y, t_z - along * n_z)
            axes[k, 0, 0], axes[k, 0, 1], axes[k, 0, 2] = rotate(pose, t_x, t_y, t_z)
            b_x, b_y, b_z = n_y * t_z - n_z * t_y, n_z * t_x - n_x * t_z, n_x * t_y - n_y * t_x
            axes[k, 1, 0], axes[k, 1, 1], axes[k, 1, 2] = rotate(pose, b_x, b_y, b_z)

    return fill


@cache
def mirrored_views_forward(real: type) -> Kernel:
    """Fills poses, normals and half spaces of all planes in one thread.

    With m = R n the pose mirrored about a plane has the rotation R - 2 m n^T and the translation t + 2 (c . n) m.
    """
    unit, rotate = vector_maths(real)
    zero, one, two = real(0.0), real(1.0), real(2.0)

    @kernel("mirrored_views_forward", real, "real2 real2 real2 real3 real2 real2")
    def forward(centers, raw_normals, pose, poses, normals, half_spaces):
        for k in range(centers.shape[0]):
            n_x, n_y, n_z, _ = unit(raw_normals[k, 0], raw_normals[k, 1], raw_normals[k, 2])
            normals[k, 0], normals[k, 1], normals[k, 2] = rotate(pose, n_x, n_y, n_z)
            offset = centers[k, 0] * n_x + centers[k, 1] * n_y + centers[k, 2] * n_z
            # The camera's centre is -R^T t, so that its height above the plane is -t . m - c . n.
            height = -offset
            for i in range(3):
                m = normals[k, i]
                poses[k, i, 0] = pose[i, 0] - two * m * n_x
                poses[k, i, 1] = pose[i, 1] - two * m * n_y
                poses[k, i, 2] = pose[i, 2] - two * m * n_z
                poses[k, i, 3] = pose[i, 3] + two * offset * m
                poses[k, 3, i] = zero
                height -= pose[i, 3] * m
            poses[k, 3, 3] = one
            side = one if height > zero else (-one if height < zero else zero)
            half_spaces[k, 0], half_spaces[k, 1], half_spaces[k, 2] = side * n_x, side * n_y, side * n_z
            half_spaces[k, 3] = -side * offset

    return forward


@cache
def mirrored_views_backward(real: type) -> Kernel:
    """Fills the gradients of centres, raw normals and pose in one thread."""
    unit, rotate = vector_maths(real)
    zero, two = real(0.0), real(2.0)

    @kernel("mirrored_views_backward", real, "real2 real2 real2 real3 real2 real2 real2 real2")
    def backward(centers, raw_normals, pose, v_poses, v_normals, v_centers, v_raw_normals, v_pose):
        for i in range(4):
            for j in range(4):
                v_pose[i, j] = zero
        for k in range(centers.shape[0]):
            n_x, n_y, n_z, inverse = unit(raw_normals[k, 0], raw_normals[k, 1], raw_normals[k, 2])
            m_x, m_y, m_z = rotate(pose, n_x, n_y, n_z)
            offset = centers[k, 0] * n_x + centers[k, 1] * n_y + centers[k, 2] * n_z
            v_x, v_y, v_z, v_offset = zero, zero, zero, zero
            for i in range(3):
                m = m_x if i == 0 else (m_y if i == 1 else m_z)
                row_x, row_y, row_z, row_t = v_poses[k, i, 0], v_poses[k, i, 1], v_poses[k, i, 2], v_poses[k, i, 3]
                v_m = v_normals[k, i] + two * (offset * row_t - row_x * n_x - row_y * n_y - row_z * n_z)
                v_offset += two * row_t * m
                v_x += v_m * pose[i, 0] - two * row_x * m
                v_y += v_m * pose[i, 1] - two * row_y * m
                v_z += v_m * pose[i, 2] - two * row_z * m
                v_pose[i, 0] += row_x + v_m * n_x
                v_pose[i, 1] += row_y + v_m * n_y
                v_pose[i, 2] += row_z + v_m * n_z
                v_pose[i, 3] += row_t
            v_centers[k, 0], v_centers[k, 1], v_centers[k, 2] = v_offset * n_x, v_offset * n_y, v_offset * n_z
            v_x, v_y = v_x + v_offset * centers[k, 0], v_y + v_offset * centers[k, 1]
            v_z += v_offset * centers[k, 2]
            along = v_x * n_x + v_y * n_y + v_z * n_z
            v_raw_normals[k, 0] = (v_x - along * n_x) * inverse
            v_raw_normals[k, 1] = (v_y - along * n_y) * inverse
            v_raw_normals[k, 2] = (v_z - along * n_z) * inverse

    return backward


@cache
def pane_hits_forward(real: type) -> Kernel:
    """Fills the index and the depth, and marks the tiles in which a pane is shown and its extents in the image.

    Extents reach from the image's right, lower, left and upper border to the pane's opposite edge, in pixels; 0 if not
    shown.
    """
    half, one, zero, far = real(0.5), real(1.0), real(0.0), real(np.inf)

    @kernel("pane_hits", real, "real2 real2 real3 real2 real1 real2 int2 real2 int2 real2 bool3 int2")
    def forward(
        centers, normals, axes, half_sizes, intrinsics, mask, before, depth_before, index, depth_of, tiles, extents,
    ):  # fmt: skip
        height, width = index.shape
        tile_columns = (width + TILE - 1) // TILE
        tile_row, tile_column = cuda.blockIdx.x // tile_columns, cuda.blockIdx.x % tile_columns
        row = tile_row * TILE + cuda.threadIdx.x // TILE
        column = tile_column * TILE + cuda.threadIdx.x % TILE
        if row >= height or column >= width:
            return
        x = (real(np.int32(column)) + half - intrinsics[2]) * (one / intrinsics[0])
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        least, own = zero, -1
        if before.size:
            least, own = depth_before[row, column], before[row, column]
        nearest, hit = far, -1
        for k in range(centers.shape[0]):
            c_x, c_y, c_z = centers[k, 0], centers[k, 1], centers[k, 2]
            n_x, n_y, n_z = normals[k, 0], normals[k, 1], normals[k, 2]
            u_x, u_y, u_z = axes[k, 0, 0], axes[k, 0, 1], axes[k, 0, 2]
            v_x, v_y, v_z = axes[k, 1, 0], axes[k, 1, 1], axes[k, 1, 2]
            depth = (c_x * n_x + c_y * n_y + c_z * n_z) / (n_x * x + (n_y * y + n_z))
            along_u = depth * (u_x * x + (u_y * y + u_z)) - (c_x * u_x + c_y * u_y + c_z * u_z)
            along_v = depth * (v_x * x + (v_y * y + v_z)) - (c_x * v_x + c_y * v_y + c_z * v_z)
            within = abs(along_u) <= half_sizes[k, 0] and abs(along_v) <= half_sizes[k, 1]
            if within and k != own and least < depth < nearest:
                nearest, hit = depth, k
        index[row, column] = hit
        depth_of[row, column] = nearest
        if hit >= 0 and (mask.size == 0 or mask[row, column] > zero):
            # Many threads may write here, all of them the same value.
            tiles[hit, tile_row, tile_column] = True
            cuda.atomic.max(extents, (hit, 0), np.int32(width - column))
            cuda.atomic.max(extents, (hit, 1), np.int32(height - row))
            cuda.atomic.max(extents, (hit, 2), np.int32(column + 1))
            cuda.atomic.max(extents, (hit, 3), np.int32(row + 1))

    return forward


@cache
def pane_windows_kernel(real: type) -> Kernel:
    """Fills the left, top, right and bottom edge of the pixels that show each pane; all 0 if there are none."""

    @kernel("pane_windows", real, "int2 int int real2")
    def fill(extents, width, height, windows):
        k = cuda.grid(1)
        if k < windows.shape[0]:
            shown = extents[k, 2] > 0
            windows[k, 0] = real(np.int32(width - extents[k, 0] if shown else 0))
            windows[k, 1] = real(np.int32(height - extents[k, 1] if shown else 0))
            windows[k, 2], windows[k, 3] = real(extents[k, 2]), real(extents[k, 3])

    return fill


INPUTS = "real3 real2 real4 real2 real1 int2 real1 int bool bool"


def blend_panes(inputs: Sequence[Tensor], switches: tuple[int, bool, bool]) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.panes.cpu.blend_panes`."""
    transmission, mask = inputs[:2]
    outputs = tuple(torch.empty_like(like) for like in (transmission, transmission, mask))
    blend_panes_forward(REAL_OF[mask.dtype]).over(mask.numel(), *inputs, *switches, *outputs)
    return outputs


def blend_panes_gradients(
    inputs: Sequence[Tensor], switches: tuple[int, bool, bool], cotangents: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.panes.cpu.blend_panes_gradients`."""
    mask, normals, pane = inputs[1], inputs[3], inputs[5]
    found = tuple(torch.zeros_like(tensor) for tensor in inputs[:3])
    shares = mask.new_zeros(*mask.shape, 4)
    launch = blend_panes_backward(REAL_OF[mask.dtype]).over
    launch(mask.numel(), *inputs, *switches, *cotangents, *found, shares)
    # A separate sum for each pane, in an order that does not change from run to run.
    panes = torch.arange(normals.shape[0], device=mask.device)[:, None]
    sums = (pane.flatten() == panes).to(mask.dtype) @ shares.view(-1, 4)
    return (*found, sums[:, :3].contiguous(), sums[:, 3].contiguous())


def _pane_strength(real: type) -> Scalar:
    strength, _, ray_length = pane_maths(real)
    one, half = real(1.0), real(0.5)

    @inlined
    def pane_strength(row, column, k, normals, bases, intrinsics, law):
        """Strength before the mask, the ray's x and y, its product with the normal and its length."""
        x = (real(np.int32(column)) + half - intrinsics[2]) * (one / intrinsics[0])
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        along, length = normals[k, 0] * x + (normals[k, 1] * y + normals[k, 2]), ray_length(x, y)
        raw = strength(law, bases[k], abs(along) / length)
        return raw, x, y, along, length

    return pane_strength


@cache
def blend_panes_forward(real: type) -> Kernel:
    """Fills rgb, reflection and strength."""
    pane_strength, (blend_channel, _) = _pane_strength(real), build_blend_channel(real)
    zero, one = real(0.0), real(1.0)

    @kernel("blend_panes_forward", real, f"{INPUTS} real3 real3 real2")
    def forward(
        transmission, mask, reflections, normals, bases, pane, intrinsics, law, intensity, linear,
        rgb, reflection, strength,
    ):  # fmt: skip
        i = cuda.grid(1)
        if i >= mask.size:
            return
        row, column = i // mask.shape[1], i % mask.shape[1]
        k, marked = pane[row, column], mask[row, column]
        shown = 0 <= k < normals.shape[0] and marked > zero
        share, gain = zero, one
        if shown:
            raw, _, _, _, _ = pane_strength(row, column, k, normals, bases, intrinsics, law)
            share = raw * marked
            gain = one + reflections[k, row, column, 3] if intensity else one
        strength[row, column] = share
        for d in range(3):
            behind, bright, mixed = transmission[row, column, d], zero, transmission[row, column, d]
            if shown:
                mixed, bright = blend_channel(behind, reflections[k, row, column, d], gain, share, linear)
            rgb[row, column, d] = mixed if share > zero else behind
            reflection[row, column, d] = bright

    return forward


@cache
def blend_panes_backward(real: type) -> Kernel:
    """Fills the gradients of transmission, mask and reflections, and each pixel's contribution [H, W, 4] to those of
    its pane's normal and base reflectance; all but the first start at zero.
    """
    pane_strength, (_, strength_derivatives, _) = _pane_strength(real), pane_maths(real)
    _, blend_channel_gradient = build_blend_channel(real)
    zero, one, dazzling = real(0.0), real(1.0), real(DAZZLING)

    @kernel("blend_panes_backward", real, f"{INPUTS} real3 real3 real2 real3 real2 real4 real3")
    def backward(
        transmission, mask, reflections, normals, bases, pane, intrinsics, law, intensity, linear,
        v_rgb, v_reflection, v_strength, v_transmission, v_mask, v_reflections, shares,
    ):  # fmt: skip
        i = cuda.grid(1)
        if i >= mask.size:
            return
        row, column = i // mask.shape[1], i % mask.shape[1]
        k, marked = pane[row, column], mask[row, column]
        if not (0 <= k < normals.shape[0] and marked > zero):
            for d in range(3):
                v_transmission[row, column, d] = v_rgb[row, column, d]
            return
        raw, x, y, along, length = pane_strength(row, column, k, normals, bases, intrinsics, law)
        share, v_share, v_gain = raw * marked, v_strength[row, column], zero
        gain = one + reflections[k, row, column, 3] if intensity else one
        for d in range(3):
            v_pixel = v_rgb[row, column, d]
            v_behind, v_mirrored, by_gain, by_share = blend_channel_gradient(
                transmission[row, column, d], reflections[k, row, column, d], gain, share, linear,
                v_pixel if share > zero else zero, v_reflection[row, column, d],
            )  # fmt: skip
            v_gain += by_gain
            v_share += by_share
            v_reflections[k, row, column, d] = v_mirrored
            v_transmission[row, column, d] = v_behind if share > zero else v_pixel
        v_reflections[k, row, column, 3] = v_gain if intensity else zero
        v_mask[row, column] = v_share * raw
        v_raw = v_share * marked if gain <= dazzling else zero
        by_base, by_cosine = strength_derivatives(law, bases[k], abs(along) / length)
        v_along = v_raw * by_cosine / length
        v_along = v_along if along > zero else -v_along
        shares[row, column, 0] = v_along * x
        shares[row, column, 1] = v_along * y
        shares[row, column, 2] = v_along
        shares[row, column, 3] = v_raw * by_base

    return backward


def layer_derivatives(
    strength: Tensor, transmission: Tensor, reflection: Tensor, where: Tensor, *, linear: bool
) -> tuple[Tensor, Tensor]:
    """As `glassplat.kernels.panes.cpu.layer_derivatives`."""
    through, mirrored = torch.empty_like(strength), torch.empty_like(strength)
    launch = layer_derivatives_kernel(REAL_OF[strength.dtype]).over
    launch(strength.numel(), strength, transmission, reflection, where, linear, through, mirrored)
    return through, mirrored


@cache
def layer_derivatives_kernel(real: type) -> Kernel:
    """Fills both images [H, W], one thread per pixel."""
    linear_of, linear_derivative, encoded, encoded_derivative = color_space_maths(real)
    zero, one, third = real(0.0), real(1.0), real(1.0 / 3.0)

    @kernel("layer_derivatives", real, "real2 real3 real3 bool2 bool real2 real2")
    def derivatives(strength, transmission, reflection, where, linear, through, mirrored):
        height, width = strength.shape
        i = cuda.grid(1)
        if i >= height * width:
            return
        row, x = i // width, i % width
        if not where[row, x]:
            through[row, x], mirrored[row, x] = one, zero
            return
        share, t, r = strength[row, x], transmission[row, x], reflection[row, x]
        behind, mirror_image = (t[0] + t[1] + t[2]) * third, (r[0] + r[1] + r[2]) * third
        by_behind, by_mirror_image = one - share, share
        if linear:
            lit, bright = linear_of(behind), linear_of(mirror_image)
            light = lit + share * (bright - lit)
            derivative = encoded_derivative(light, encoded(light))
            by_behind *= derivative * linear_derivative(behind, lit)
            by_mirror_image *= derivative * linear_derivative(mirror_image, bright)
        through[row, x], mirrored[row, x] = by_behind, by_mirror_image

    return derivatives


def sample_derivatives(derivatives: Tensor, surface: Tensor, means2d: Tensor, depths: Tensor) -> Tensor:
    """As `glassplat.kernels.panes.cpu.sample_derivatives`."""
    found = torch.empty_like(depths)
    launch = sample_derivatives_kernel(REAL_OF[depths.dtype]).over
    launch(depths.numel(), derivatives, surface, means2d.view(-1, 2), depths.view(-1), found.view(-1))
    return found


@cache
def sample_derivatives_kernel(real: type) -> Kernel:
    """Fills the derivative at each centre, 1 in front of the surface; one thread per splat."""
    zero, one = real(0.0), real(1.0)

    @kernel("sample_derivatives", real, "real2 real2 real2 real1 real1")
    def fill(derivatives, surface, means2d, depths, found):
        i = cuda.grid(1)
        if i >= depths.size:
            return
        x, y, right, bottom = means2d[i, 0], means2d[i, 1], derivatives.shape[1] - 1, derivatives.shape[0] - 1
        # Neither comparison holds for NaN, which counts as 0.
        column = right if x >= real(np.int32(right)) else (np.int32(x) if x > zero else 0)
        row = bottom if y >= real(np.int32(bottom)) else (np.int32(y) if y > zero else 0)
        found[i] = derivatives[row, column] if depths[i] > surface[row, column] else one

    return fill


def inside_panes(pane: Tensor, strength: Tensor) -> Tensor:
    """As `glassplat.kernels.panes.cpu.inside_panes`."""
    inside = torch.empty_like(strength)
    inside_panes_kernel(REAL_OF[strength.dtype]).over(pane.numel(), pane, strength, inside)
    return inside


@cache
def inside_panes_kernel(real: type) -> Kernel:
    """Fills 1 where a pixel and its neighbours show the same pane, and 0 elsewhere; one thread per pixel."""
    zero, one = real(0.0), real(1.0)

    @kernel("inside_panes", real, "int2 real2 real2")
    def fill(pane, strength, inside):
        height, width = pane.shape
        i = cuda.grid(1)
        if i >= height * width:
            return
        row, column = i // width, i % width
        own = pane[row, column]
        same = own >= 0
        for y in range(max(row - 1, 0), min(row + 2, height)):
            for x in range(max(column - 1, 0), min(column + 2, width)):
                same = same and strength[y, x] > zero and pane[y, x] == own
        inside[row, column] = one if same else zero

    return fill


def gradient_conflict(
    transmission: Tensor, reflection: Tensor, hit: Tensor, strength: Tensor | None, cell: int
) -> tuple[Tensor, Tensor]:
    """As `glassplat.kernels.panes.cpu.gradient_conflict`; the derivatives are [2, H - 2, W - 2, 3]."""
    height, width = hit.shape
    derivatives = transmission.new_empty(2, height - 2, width - 2, CHANNELS)
    sums = hit.new_empty(CHANNELS * -(-(height - 2) // cell) * -(-(width - 2) // cell))
    conflict_forward(REAL_OF[hit.dtype])(
        len(sums), CELL_THREADS, transmission, reflection, hit, strength, cell, derivatives, sums
    )
    return sums.sum() / conflict_count(height, width), derivatives


def gradient_conflict_gradient(derivatives: Tensor, v_mean: Tensor) -> Tensor:
    """As `glassplat.kernels.panes.cpu.gradient_conflict_gradient`."""
    height, width = derivatives.shape[1] + 2, derivatives.shape[2] + 2
    v_transmission = derivatives.new_empty(height, width, CHANNELS)
    launch = conflict_backward(REAL_OF[derivatives.dtype]).over
    launch(v_transmission.numel(), derivatives, v_mean.view(1), v_transmission)
    return v_transmission


CELL_THREADS = 64


@inlined
def sobel_at(image, y, x, d):
    """Sobel derivatives of a channel along both axes at an inner pixel."""
    a, b, c = image[y - 1, x - 1, d], image[y - 1, x, d], image[y - 1, x + 1, d]
    e, f = image[y, x - 1, d], image[y, x + 1, d]
    g, h, i = image[y + 1, x - 1, d], image[y + 1, x, d], image[y + 1, x + 1, d]
    right, below = f - e, h - b
    return c - a + right + right + i - g, g - a + below + below + i - c


@cache
def conflict_forward(real: type) -> Kernel:
    """Fills the sum of each cell and channel, and its derivatives [2, H - 2, W - 2, 3] by the Sobel images."""
    zero, one, darkest = real(0.0), real(1.0), real(DARKEST)

    @kernel("gradient_conflict_forward", real, "real3 real3 real2 real2 int real4 real1")
    def forward(transmission, reflection, hit, strength, cell, derivatives, sums):
        edges = cuda.shared.array(CELL_THREADS, real)
        holds = cuda.shared.array(CELL_THREADS, real)
        fills = cuda.shared.array(CELL_THREADS, real)
        height, width, t = hit.shape[0], hit.shape[1], cuda.threadIdx.x
        d, n, across = cuda.blockIdx.x % CHANNELS, cuda.blockIdx.x // CHANNELS, (width - 3 + cell) // cell
        top, left = 1 + n // across * cell, 1 + n % across * cell
        rows, columns = min(cell, height - 1 - top), min(cell, width - 1 - left)
        shared, held, full = zero, zero, zero
        for i in range(t, rows * columns, CELL_THREADS):
            y, x = top + i // columns, left + i % columns
            t_x, t_y = sobel_at(transmission, y, x, d)
            r_x, r_y = sobel_at(reflection, y, x, d)
            product = hit[y, x] * (t_x * r_x + t_y * r_y)
            shared += product
            if strength.size > 0:
                light_t = min(max(transmission[y, x, d], darkest), one)
                light_r = min(max(reflection[y, x, d], darkest), one)
                held += light_t * light_r * product
                full += hit[y, x] * strength[y, x] * light_r * light_r * (r_x * r_x + r_y * r_y)
        edges[t], holds[t], fills[t] = shared, held, full
        step = CELL_THREADS // 2
        while step > 0:
            cuda.syncthreads()
            if t < step:
                edges[t] += edges[t + step]
                holds[t] += holds[t + step]
                fills[t] += fills[t + step]
            step //= 2
        cuda.syncthreads()
        added, factor = weighted_edges(edges[0], holds[0], fills[0], strength.size > 0)
        if t == 0:
            sums[cuda.blockIdx.x] = added
        for i in range(t, rows * columns, CELL_THREADS):
            y, x = top + i // columns, left + i % columns
            r_x, r_y = sobel_at(reflection, y, x, d)
            weight = factor * hit[y, x]
            derivatives[0, y - 1, x - 1, d] = weight * r_x
            derivatives[1, y - 1, x - 1, d] = weight * r_y

    return forward


@cache
def conflict_backward(real: type) -> Kernel:
    """Fills the gradient of the transmission [H, W, 3], by the transposed Sobel operators on the derivatives."""
    zero, one, two, count = real(0.0), real(1.0), real(2.0), real(CHANNELS)

    @kernel("gradient_conflict_backward", real, "real4 real1 real3")
    def backward(derivatives, v_mean, v_transmission):
        height, width, i = v_transmission.shape[0], v_transmission.shape[1], cuda.grid(1)
        if i >= v_transmission.size:
            return
        d, column, row = i % CHANNELS, i // CHANNELS % width, i // CHANNELS // width
        total = zero
        for down in range(-1, 2):
            for right in range(-1, 2):
                y, x = row + down, column + right
                if 0 < y < height - 1 and 0 < x < width - 1:
                    across = two if down == 0 else one
                    along = two if right == 0 else one
                    total -= real(np.int32(right)) * across * derivatives[0, y - 1, x - 1, d]
                    total -= real(np.int32(down)) * along * derivatives[1, y - 1, x - 1, d]
        inner = real(np.int32(height - 2)) * real(np.int32(width - 2))
        v_transmission[row, column, d] = v_mean[0] / (count * inner) * total

    return backward
