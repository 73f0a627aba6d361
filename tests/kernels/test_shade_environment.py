"""`shade_environment` against its twin."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from glassplat.kernels.environment import cube_lookup, shade_environment
from glassplat.kernels.environment.reference import shade_environment as twin
from glassplat.kernels.records import NORMAL_MIN, Shaded
from tests.kernels.threads import assert_threads_change_no_bit

INPUTS = ("blended", "alpha", "texels", "world_from_cam")
WIDTH, HEIGHT = 29, 23
NORMAL, STRENGTH = slice(3, 6), 6
BACKGROUND = (0.5, 1.0, 0.25)


def shade_case(dtype: torch.dtype, height: int = HEIGHT, width: int = WIDTH, size: int = 6) -> dict[str, Tensor]:
    """Random arguments, one channel of them unused.

    The left quarter and a pixel have no normals, a tenth of the strengths is 0.
    """
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    normals = 2 * draw(height, width, 3) - 1
    normals[:, : width // 4] = 0
    normals[1:2, width // 2] = 0
    strength = draw(height, width)
    strength = torch.where(strength < 0.1, 0, strength)[..., None]
    case = {
        "blended": torch.cat([draw(height, width, 3), normals, strength, draw(height, width, 1)], dim=-1),
        "alpha": draw(height, width),
        "texels": 4 * draw(6, size, size, 3) - 2,
        "intrinsics": torch.tensor([20.0, 21.0, width / 2 + 0.3, height / 2 - 0.4], dtype=torch.float64),
        "world_from_cam": torch.linalg.qr(draw(3, 3))[0],
    }
    return {name: tensor.to(dtype) for name, tensor in case.items()}


def with_gradients(
    case: dict[str, Tensor], function: Callable[..., Shaded], least_strength: float = 0.0
) -> list[Tensor]:
    inputs = {name: case[name].detach().requires_grad_() for name in INPUTS}
    result = function(**(case | inputs), background=BACKGROUND, least_strength=least_strength)
    generator = torch.Generator().manual_seed(3)
    weights = [torch.randn(t.shape, generator=generator, dtype=torch.float64).to(t) for t in result]
    total = sum((t * w).sum() for t, w in zip(result, weights, strict=True))
    return [*(t.detach() for t in result), *torch.autograd.grad(total, list(inputs.values()))]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-11)])
@pytest.mark.parametrize(
    ("height", "width", "size"), [(23, 29, 6), (1, 1, 1), (0, 5, 2), (8, 9, 1), (3, 100, 5), (2, 128, 4)]
)
@pytest.mark.parametrize("least_strength", [0.0, 0.5])
def test_shading_matches_the_reference(
    dtype: torch.dtype, tolerance: float, height: int, width: int, size: int, least_strength: float
) -> None:
    case = shade_case(dtype, height, width, size)
    found, expected = (with_gradients(case, f, least_strength) for f in (shade_environment, twin))
    for tensor, other in zip(found, expected, strict=True):
        scale = max(1.0, float(other.abs().max())) if other.numel() else 1.0
        torch.testing.assert_close(tensor, other, rtol=tolerance, atol=tolerance * scale)


@pytest.mark.parametrize("name", INPUTS)
def test_gradients_match_finite_differences(name: str) -> None:
    case = shade_case(torch.float64, 4, 6, 3)
    normals = case["blended"][..., NORMAL]
    normals[normals == 0] = 0.7
    assert torch.autograd.gradcheck(
        lambda moved: tuple(shade_environment(**(case | {name: moved}), background=BACKGROUND)),
        case[name].requires_grad_(),
        eps=1e-7,
        atol=1e-5,
        fast_mode=True,
    )


def test_the_equation_holds_as_the_paper_writes_it() -> None:
    case = shade_case(torch.float64)
    result = shade_environment(**case, background=BACKGROUND)
    row, column = 11, 20
    fx, fy, cx, cy = case["intrinsics"]
    in_camera = torch.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, torch.ones_like(fx)])
    v = -torch.nn.functional.normalize(case["world_from_cam"] @ in_camera, dim=0)
    pixel = case["blended"][row, column]
    n = torch.nn.functional.normalize(pixel[NORMAL], dim=0)
    mirrored = torch.sigmoid(cube_lookup(case["texels"], 2 * (v @ n) * n - v))
    base = pixel[:3] + (1 - case["alpha"][row, column]) * torch.tensor(BACKGROUND)
    share = pixel[STRENGTH]
    torch.testing.assert_close(result.base[row, column], base)
    torch.testing.assert_close(result.reflection[row, column], mirrored)
    torch.testing.assert_close(result.rgb[row, column], (1 - share) * base + share * mirrored)


def test_a_surface_that_faces_the_camera_mirrors_what_is_behind_it() -> None:
    case = shade_case(torch.float64)
    colors = torch.linspace(-3, 3, 18, dtype=torch.float64).reshape(6, 1, 1, 3)
    case["texels"] = colors.expand(6, 5, 5, 3)
    case["world_from_cam"] = torch.eye(3, dtype=torch.float64)
    case["blended"][..., NORMAL] = torch.tensor([0.0, 0.0, -0.3], dtype=torch.float64)
    middle = shade_environment(**case).reflection[HEIGHT // 2, WIDTH // 2]
    torch.testing.assert_close(middle, torch.sigmoid(colors[5, 0, 0]))


def test_without_normal_or_strength_the_image_is_the_base_bit_for_bit() -> None:
    case = shade_case(torch.float32)
    case["blended"][3, 20, NORMAL] = torch.tensor([NORMAL_MIN / 2, 0, 0])
    bare = case["blended"][..., NORMAL].norm(dim=-1) <= NORMAL_MIN
    unlit = case["blended"][..., STRENGTH] == 0
    rgb, base, reflection, v_blended, *_ = with_gradients(case, shade_environment)
    v_strength = v_blended[..., STRENGTH]
    assert bool(bare.any()) and bool((unlit & ~bare).any())
    assert torch.equal(rgb[bare | unlit], base[bare | unlit])
    assert float(reflection[bare].abs().max()) == 0 == float(v_blended[bare][:, 3:].abs().max())
    assert float(v_blended[bare][:, :3].abs().min()) > 0
    assert float(v_strength[unlit & ~bare].abs().min()) > 0 < float(reflection[unlit & ~bare].min())


def test_before_black_the_base_is_the_blended_colour_bit_for_bit() -> None:
    case = shade_case(torch.float32)
    assert torch.equal(shade_environment(**case).base, case["blended"][..., :3])


def test_weakly_reflecting_pixels_show_the_base_colour() -> None:
    case = shade_case(torch.float32)
    dull = case["blended"][..., STRENGTH] < 0.5
    assert bool(dull.any()) and not bool(dull.all())
    every, some = (with_gradients(case, shade_environment, least) for least in (0.0, 0.5))
    for tensor, other in zip(some[:-2], every[:-2], strict=True):
        assert torch.equal(tensor[~dull], other[~dull])
    rgb, base, reflection, v_blended, *_ = some
    assert torch.equal(rgb[dull], base[dull])
    assert all(float(tensor[dull].abs().max()) == 0 for tensor in (reflection, v_blended[..., 3:]))


def test_the_length_and_the_sign_of_a_normal_do_not_matter() -> None:
    case = shade_case(torch.float64)
    for factor in (-1.0, 1e-4):
        blended = case["blended"].clone()
        blended[..., NORMAL] *= factor
        for tensor, other in zip(
            shade_environment(**case), shade_environment(**(case | {"blended": blended})), strict=True
        ):
            torch.testing.assert_close(tensor, other)


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_a_nan_normal_gives_nan_and_does_not_affect_others(poison: float) -> None:
    case = shade_case(torch.float32)
    case["blended"][5, 15, NORMAL] = torch.tensor([0.1, poison, 0.2])
    case["blended"][5, 15, STRENGTH] = 0.5
    for function in (shade_environment, twin):
        rgb = function(**case).rgb
        assert bool(rgb[5, 15].isnan().all()) and int(rgb.isnan().sum()) == 3


def test_nan_texels_give_nan() -> None:
    case = shade_case(torch.float32)
    case["texels"][:] = float("nan")
    lit = (case["blended"][..., NORMAL] != 0).any(-1)
    for function in (shade_environment, twin):
        reflection = function(**case).reflection
        assert bool(reflection[lit].isnan().all()) and bool((reflection[~lit] == 0).all())


def test_threads_do_not_change_a_bit() -> None:
    case = shade_case(torch.float32)
    assert_threads_change_no_bit(lambda: with_gradients(case, shade_environment))


def test_bad_input_is_named() -> None:
    case = shade_case(torch.float32)
    for name in ("blended", "intrinsics", "world_from_cam"):
        with pytest.raises(ValueError, match=f"{name} has shape"):
            shade_environment(**(case | {name: torch.zeros(2, 2)}))
    with pytest.raises(ValueError, match="first 7 channels"):
        shade_environment(**(case | {"blended": case["blended"][..., :6]}))
    with pytest.raises(ValueError, match="six square faces"):
        shade_environment(**(case | {"texels": torch.zeros(6, 0, 0, 3)}))
    with pytest.raises(ValueError, match="texels has shape"):
        shade_environment(**(case | {"texels": torch.zeros(6, 2, 2, 4)}))
    with pytest.raises(TypeError, match=r"alpha is torch\.float64"):
        shade_environment(**(case | {"alpha": case["alpha"].double()}))
