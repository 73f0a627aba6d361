from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from glassplat.kernels.composite import Composite, composite
from glassplat.kernels.composite.reference import composite as composite_twin
from glassplat.kernels.records import Deviation, Splats, TileBins
from glassplat.kernels.tiles import bin_tiles
from tests.kernels.threads import assert_threads_change_no_bit

MakeSplats = Callable[..., Splats]
INPUTS = ("means2d", "conics", "opacities", "channels", "marks", "absgrad")


class Blend(NamedTuple):
    """All arguments of a call of `composite`; `inputs` are its differentiable tensors."""

    splats: Splats
    channels: Tensor
    marks: Tensor
    num_primary: int
    bins: TileBins
    absgrad: Tensor
    deviation: Deviation | None = None

    def __call__(self, function: Callable[..., Composite]) -> Composite:
        return function(
            self.splats, self.channels, self.bins,
            marks=self.marks, num_primary=self.num_primary, deviation=self.deviation, absgrad=self.absgrad,
        )  # fmt: skip

    def inputs(self) -> list[Tensor]:
        return [*self.splats[:3], self.channels, self.marks, self.absgrad]


def blend(splats: Splats, size: tuple[int, int], *, channels: int = 3, glass: int = 0, seed: int = 1) -> Blend:
    """Random channels and marks for the splats, of which the last `glass` of each camera are glass."""
    generator = torch.Generator().manual_seed(seed)
    cameras, count = splats.opacities.shape
    dtype = splats.means2d.dtype
    values = torch.rand(cameras, count, channels, generator=generator, dtype=torch.float64).to(dtype)
    marks = torch.rand(cameras, glass, generator=generator, dtype=torch.float64).to(dtype)
    return Blend(splats, values, marks, count - glass, bin_tiles(splats, *size), torch.zeros_like(splats.means2d))


def deviating(case: Blend, channel: int, *, through_mean: bool) -> Blend:
    """The same call that also requests a channel's deviation, with a random factor that is 0 in whole tiles."""
    generator = torch.Generator().manual_seed(7)
    shape = (case.bins.num_cameras, case.bins.height, case.bins.width)
    where = torch.rand(*shape, generator=generator, dtype=torch.float64).to(case.channels.dtype)
    where[:, :17, :16] = 0
    return case._replace(deviation=Deviation(channel, where, through_mean))


def with_gradients(case: Blend, function: Callable[..., Composite], seed: int = 2) -> dict[str, Tensor]:
    """Outputs and, for random cotangents, the gradients of all inputs."""
    inputs = [tensor.detach().requires_grad_() for tensor in case.inputs()]
    means2d, conics, opacities, channels, marks, absgrad = inputs
    splats = case.splats._replace(means2d=means2d, conics=conics, opacities=opacities)
    outputs = case._replace(splats=splats, channels=channels, marks=marks, absgrad=absgrad)(function)
    generator = torch.Generator().manual_seed(seed)
    cotangents = [torch.randn(o.shape, generator=generator, dtype=torch.float64).to(o.dtype) for o in outputs]
    # The twin does not touch inputs that reach no pixel; the added zero gives them a gradient of zero.
    total = sum((o * c).sum() for o, c in zip(outputs, cotangents, strict=True)) + 0 * sum(i.sum() for i in inputs)
    gradients = torch.autograd.grad(total, inputs)
    named = outputs._asdict() | {f"v_{name}": g for name, g in zip(INPUTS, gradients, strict=True)}
    return {name: tensor.detach() for name, tensor in named.items()}


def assert_close(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    """Relative norm of the difference, and the cosine between the two, per tensor."""
    for name, want in expected.items():
        got, want = found[name].double().flatten(), want.double().flatten()
        size = float(want.norm())
        assert float((got - want).norm()) <= tolerance * max(size, 1e-3), name
        if size > 0:
            assert float(got @ want) / (size * float(got.norm())) > 1 - tolerance, name


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize(
    ("cameras", "count", "glass", "channels", "size"),
    [
        (1, 0, 0, 3, (20, 20)),
        (1, 1, 0, 3, (20, 20)),
        (1, 1, 1, 1, (16, 16)),
        (1, 40, 0, 1, (37, 29)),
        (2, 60, 20, 5, (40, 33)),
        (2, 60, 20, 7, (40, 33)),
        (1, 40, 10, 9, (17, 50)),
    ],
)
def test_kernel_matches_the_reference(
    random_splats: MakeSplats, dtype: torch.dtype, tolerance: float,
    cameras: int, count: int, glass: int, channels: int, size: tuple[int, int],
) -> None:  # fmt: skip
    case = blend(random_splats((cameras, count), size, dtype=dtype), size, channels=channels, glass=glass)
    assert_close(with_gradients(case, composite), with_gradients(case, composite_twin), tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-4), (torch.float64, 1e-11)])
@pytest.mark.parametrize("through_mean", [False, True])
@pytest.mark.parametrize(
    ("cameras", "count", "glass", "channels", "channel"), [(1, 0, 0, 4, 3), (2, 80, 20, 4, 3), (1, 60, 5, 9, 6)]
)
def test_deviation_matches_the_reference(
    random_splats: MakeSplats, dtype: torch.dtype, tolerance: float, through_mean: bool,
    cameras: int, count: int, glass: int, channels: int, channel: int,
) -> None:  # fmt: skip
    size = (40, 37)
    splats = random_splats((cameras, count), size, dtype=dtype, sigmas=(2.0, 9.0))
    case = deviating(blend(splats, size, channels=channels, glass=glass), channel, through_mean=through_mean)
    found = with_gradients(case, composite)
    assert count == 0 or float(found["deviation"].max()) > 0.05
    assert not bool(found["deviation"][:, :17, :16].any())
    assert_close(found, with_gradients(case, composite_twin), tolerance)


def test_requesting_the_deviation_changes_nothing_else(random_splats: MakeSplats) -> None:
    case = blend(random_splats((1, 80), (40, 37), dtype=torch.float32), (40, 37), channels=4, glass=20)
    plain, asked = case(composite), deviating(case, 3, through_mean=False)(composite)
    assert all(torch.equal(a, b) for a, b in zip(plain[:3], asked[:3], strict=True))
    assert plain.deviation.numel() == 0


def test_a_surface_deviates_nowhere(random_splats: MakeSplats) -> None:
    case = blend(random_splats((1, 30), (20, 20)), (20, 20), channels=4)
    case.channels[..., 3] = 3.0
    case = case._replace(deviation=Deviation(3, torch.ones(1, 20, 20, dtype=torch.float64)))
    assert float(case(composite).deviation.max()) < 1e-12


@pytest.mark.parametrize("channels", [1, 6])
@pytest.mark.parametrize("function", [composite, composite_twin])
def test_the_deviation_of_a_splat_alone_has_no_gradient(function: Callable[..., Composite], channels: int) -> None:
    """Where its coverage is small its mean is uncertain, but its weight there is negligible."""
    fields = (torch.tensor([20.3, 15.2]), torch.tensor([0.01, 0.0, 0.01]), torch.tensor(0.8), torch.tensor(3.0))
    splats = Splats(*(field[None, None] for field in fields), torch.full((1, 1, 2), 40.0))
    values = torch.full((1, 1, channels), 3.1, requires_grad=True)
    asked = Deviation(channels - 1, torch.ones(1, 36, 44))
    found = function(splats, values, bin_tiles(splats, 44, 36), deviation=asked)
    gradient, covered = torch.autograd.grad(found.deviation.sum(), values)[0], found.alpha.detach()
    assert float(gradient.abs().sum()) < 1e-3 * float(covered.sum())


def test_two_layers_deviate_by_their_weighted_distance_from_the_mean() -> None:
    splats = two_discs(depths=(1.0, 3.0), opacities=(0.5, 0.8))
    bins = bin_tiles(splats, 16, 16)
    found = composite(splats, splats.depths[..., None], bins, deviation=Deviation(0, torch.full((1, 16, 16), 2.0)))
    near, far = 0.5, 0.5 * 0.8
    mean = (near * 1 + far * 3) / (near + far)
    expected = 2 * (near * (mean - 1) + far * (3 - mean))
    torch.testing.assert_close(found.deviation, torch.full((1, 16, 16), expected), rtol=1e-4, atol=0)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-4), (torch.float64, 1e-12)])
def test_opaque_splats_end_a_pixel_where_the_reference_ends_it(
    random_splats: MakeSplats, dtype: torch.dtype, tolerance: float
) -> None:
    splats = random_splats((1, 200), (24, 20), dtype=dtype, opacities=(0.8, 1.0), sigmas=(5.0, 20.0))
    case = blend(splats, (24, 20), glass=60)
    found = with_gradients(case, composite)
    assert float(found["alpha"].min()) > 0.99
    assert float(found["v_channels"].abs().sum(dim=-1).count_nonzero()) < 100
    assert_close(found, with_gradients(case, composite_twin), tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_needle_reaches_all_its_pixels(dtype: torch.dtype) -> None:
    """Blocks of a tile that a splat does not reach are skipped; blocks that it grazes must not be."""
    count, size = 150, (70, 50)
    generator = torch.Generator().manual_seed(11)
    angle = torch.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    along = torch.stack([angle.cos(), angle.sin()], 1)
    across = torch.stack([-angle.sin(), angle.cos()], 1)
    length = 2 + 58 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    thickness = 0.55 + 3 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    xx, xy, yy = (
        along[:, i] * along[:, j] / length[:, 0] ** 2 + across[:, i] * across[:, j] / thickness[:, 0] ** 2
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    means = torch.rand(count, 2, generator=generator, dtype=torch.float64) * 90 - 10
    opacities = 0.01 + 0.99 * torch.rand(count, generator=generator, dtype=torch.float64)
    fields = means, torch.stack([xx, xy, yy], 1), opacities, torch.ones(count), torch.full((count, 2), 200.0)
    splats = Splats(*(field[:, None].to(dtype) for field in fields))
    bins = bin_tiles(splats, *size)
    channels = torch.ones(count, 1, 1, dtype=dtype)
    found, expected = (function(splats, channels, bins).alpha for function in (composite, composite_twin))
    grazed = (expected > 0.98 / 255) & (expected < 1.02 / 255) | (expected == 0) & (found < 1.02 / 255)
    torch.testing.assert_close(found[~grazed], expected[~grazed], atol=1e-4, rtol=1e-3)
    assert int((expected > 0).sum()) > 20_000


def test_a_needle_whose_determinant_cancels_in_single_precision_is_drawn() -> None:
    """Its standard deviations are 10,000 px and 0.55 px."""
    angle, length, thickness = 0.3, 1e4, 0.55
    c, s = math.cos(angle), math.sin(angle)
    xx, yy = ((x / length) ** 2 + (y / thickness) ** 2 for x, y in ((c, s), (s, c)))
    conic = torch.tensor([xx, c * s * (length**-2 - thickness**-2), yy])
    assert not conic[0] * conic[2] - conic[1] * conic[1] > 0
    fields = torch.tensor([10.0, 9.0]), conic, torch.tensor(0.8), torch.tensor(1.0), torch.tensor([1e4, 1e4])
    case = blend(Splats(*(field[None, None] for field in fields)), (24, 20))
    found, expected = with_gradients(case, composite), with_gradients(case, composite_twin)
    assert float(found["alpha"].max()) > 0.7
    assert_close(found, expected, 1e-3)


def test_many_glass_layers_have_finite_gradients(random_splats: MakeSplats) -> None:
    splats = random_splats((1, 60), (20, 20), dtype=torch.float32, opacities=(0.98, 1.0), sigmas=(20.0, 30.0))
    case = blend(splats, (20, 20), glass=60)
    found = with_gradients(case, composite)
    assert all(bool(tensor.isfinite().all()) for tensor in found.values())
    assert_close(found, with_gradients(case, composite_twin), 1e-3)


def test_gradients_match_finite_differences(random_splats: MakeSplats) -> None:
    size = (19, 18)
    splats = random_splats((1, 7), size, opacities=(0.3, 0.8), sigmas=(2.0, 6.0), seed=3)
    case = deviating(blend(splats, size, channels=2, glass=3), 1, through_mean=True)

    cotangents = [torch.randn_like(output) for output in case(composite)]

    def weighted(means2d: Tensor, conics: Tensor, opacities: Tensor, channels: Tensor, marks: Tensor) -> Tensor:
        moved = splats._replace(means2d=means2d, conics=conics, opacities=opacities)
        outputs = case._replace(splats=moved, channels=channels, marks=marks)(composite)
        return torch.stack([(o * c).sum() for o, c in zip(outputs, cotangents, strict=True)])

    inputs = [tensor.detach().clone().requires_grad_() for tensor in case.inputs()[:5]]
    assert torch.autograd.gradcheck(weighted, inputs, eps=1e-7, atol=1e-6, rtol=1e-6)


def test_gradients_of_pixels_add_up_without_their_signs(random_splats: MakeSplats) -> None:
    size = (11, 9)
    splats = random_splats((1, 12), size, opacities=(0.3, 0.8), sigmas=(2.0, 6.0), seed=5)
    case = blend(splats, size, glass=4)
    means2d, absgrad = case.splats.means2d.requires_grad_(), case.absgrad.requires_grad_()
    outputs = case._replace(splats=splats._replace(means2d=means2d), absgrad=absgrad)(composite)
    values = outputs.image.sum(-1) + 2 * outputs.mask
    total = torch.zeros_like(means2d)
    for pixel in values.flatten():
        total += torch.autograd.grad(pixel, means2d, retain_graph=True)[0].abs()
    (found,) = torch.autograd.grad(values.sum(), absgrad, retain_graph=True)
    (signed,) = torch.autograd.grad(values.sum(), means2d)
    torch.testing.assert_close(found, total)
    assert bool((found > 1.5 * signed.abs()).any())


def test_the_value_of_absgrad_changes_nothing(random_splats: MakeSplats) -> None:
    size = (40, 33)
    case = blend(random_splats((2, 60), size, dtype=torch.float32), size, glass=20)
    plain, with_absgrad = (
        with_gradients(case, composite),
        with_gradients(case._replace(absgrad=case.absgrad + 3), composite),
    )
    assert all(torch.equal(plain[name], with_absgrad[name]) for name in plain)


def test_requesting_absgrad_changes_no_other_gradient(random_splats: MakeSplats) -> None:
    case = blend(random_splats((1, 30), (20, 20), dtype=torch.float32), (20, 20))
    channels = case.channels.requires_grad_()
    asked = torch.autograd.grad(case._replace(absgrad=case.absgrad.requires_grad_())(composite).image.sum(), channels)
    plain = torch.autograd.grad(composite(case.splats, channels, case.bins).image.sum(), channels)
    assert torch.equal(asked[0], plain[0])


def test_clamped_coverage_passes_no_gradient_to_geometry() -> None:
    splats = Splats(
        torch.full((1, 1, 2), 8.5), torch.tensor([[[1e-6, 0, 1e-6]]]), torch.ones(1, 1), torch.ones(1, 1),
        torch.full((1, 1, 2), 4e3),
    )  # fmt: skip
    found = with_gradients(blend(splats, (16, 16)), composite)
    torch.testing.assert_close(found["alpha"], torch.full((1, 16, 16), 0.99))
    assert not found["v_opacities"].any()
    assert not found["v_means2d"].any()
    assert found["v_channels"].any()


def test_only_active_tiles_are_drawn(random_splats: MakeSplats) -> None:
    size = (60, 40)
    full = deviating(blend(random_splats((2, 50), size, dtype=torch.float32), size, glass=10), 1, through_mean=True)
    tiles = torch.zeros(2, 3, 4, dtype=torch.bool)
    tiles[0, 1, 2] = tiles[1, 0, 0] = tiles[1, 2, 3] = True
    few = full._replace(bins=bin_tiles(full.splats, *size, tiles))
    seen = tiles.repeat_interleave(16, 1).repeat_interleave(16, 2)[:, :40, :60]
    everywhere, there = full(composite), few(composite)
    for all_tiles, some_tiles in zip(everywhere, there, strict=True):
        assert torch.equal(some_tiles[seen], all_tiles[seen])
        assert not some_tiles[~seen].any()
    assert_close(with_gradients(few, composite), with_gradients(few, composite_twin), 2e-5)

    # Bins of every tile with a shorter list of active ones must give the same result.
    shortened = full._replace(bins=full.bins._replace(active=few.bins.active))
    expected = with_gradients(few, composite)
    assert all(torch.equal(t, expected[name]) for name, t in with_gradients(shortened, composite).items())


def test_the_number_of_threads_changes_no_bit(random_splats: MakeSplats) -> None:
    size = (100, 70)
    case = blend(random_splats((2, 300), size, dtype=torch.float32), size, channels=4, glass=50)
    assert_threads_change_no_bit(lambda: with_gradients(case, composite).values())


def test_glass_never_changes_the_image(random_splats: MakeSplats) -> None:
    size = (40, 40)
    case = blend(random_splats((1, 60), size, dtype=torch.float32), size, glass=20)
    kept = Splats(*(tensor[:, :40] for tensor in case.splats))
    alone = composite(kept, case.channels[:, :40], bin_tiles(kept, *size))
    together = case(composite)
    assert torch.equal(together.image, alone.image)
    assert torch.equal(together.alpha, alone.alpha)
    assert together.mask.any()
    assert not alone.mask.any()


def two_discs(depths: tuple[float, float], opacities: tuple[float, float]) -> Splats:
    """A primary and a glass splat that both cover a 16 x 16 image evenly."""
    return Splats(
        torch.full((1, 2, 2), 8.0), torch.tensor([[[1e-7, 0.0, 1e-7]] * 2]), torch.tensor([opacities]),
        torch.tensor([depths]), torch.full((1, 2, 2), 1e4),
    )  # fmt: skip


def test_a_primary_splat_in_front_hides_glass() -> None:
    channels, marks = torch.ones(1, 2, 1), torch.full((1, 1), 0.5)
    masks = {}
    for order, depths in {"behind": (1.0, 2.0), "in front": (2.0, 1.0)}.items():
        splats = two_discs(depths, (0.6, 0.8))
        masks[order] = composite(splats, channels, bin_tiles(splats, 16, 16), marks=marks, num_primary=1).mask
    torch.testing.assert_close(masks["in front"], torch.full((1, 16, 16), 0.5 * 0.8), atol=1e-4, rtol=0)
    torch.testing.assert_close(masks["behind"], torch.full((1, 16, 16), 0.5 * 0.8 * 0.4), atol=1e-4, rtol=0)


def test_a_nan_channel_affects_only_its_tiles(random_splats: MakeSplats) -> None:
    size = (80, 80)
    case = blend(random_splats((1, 60), size, dtype=torch.float32, sigmas=(1.0, 3.0)), size)
    clean = case(composite).image
    poisoned = case.channels.clone()
    poisoned[0, 7] = torch.nan
    image = case._replace(channels=poisoned)(composite).image
    reached = torch.zeros(5, 5, dtype=torch.bool)
    pairs = torch.repeat_interleave(torch.arange(25), case.bins.tile_offsets.diff())
    reached.view(-1)[pairs[case.bins.pair_splats == 7]] = True
    outside = ~reached.repeat_interleave(16, 0).repeat_interleave(16, 1)
    assert torch.equal(image[0][outside], clean[0][outside])
    assert image.isnan().any()


@pytest.mark.parametrize("field", ["means2d", "conics", "opacities"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_a_splat_with_broken_geometry_is_not_drawn(random_splats: MakeSplats, field: str, value: float) -> None:
    size = (40, 40)
    case = blend(random_splats((1, 30), size, dtype=torch.float32), size)
    broken = getattr(case.splats, field).clone()
    broken[0, 4] = value
    # Binning leaves such splats out; a list that nevertheless holds them must do no harm.
    found = with_gradients(case._replace(splats=case.splats._replace(**{field: broken})), composite)
    culled = case.splats.radii.clone()
    culled[0, 4] = 0
    without = case.splats._replace(radii=culled)
    expected = case._replace(splats=without, bins=bin_tiles(without, *size))(composite)
    torch.testing.assert_close(found["image"], expected.image)
    assert not found["v_channels"][0, 4].any()


def test_wrong_inputs_are_named(random_splats: MakeSplats) -> None:
    case = blend(random_splats((1, 5), (20, 20)), (20, 20), glass=2)
    splats, channels, bins = case.splats, case.channels, case.bins
    with pytest.raises(ValueError, match="2 splats are glass, but there are no marks"):
        composite(splats, channels, bins, num_primary=3)
    with pytest.raises(ValueError, match=r"marks has shape \(1, 2\); expected \(1, 1\)"):
        composite(splats, channels, bins, marks=case.marks, num_primary=4)
    with pytest.raises(ValueError, match="num_primary is 6"):
        composite(splats, channels, bins, num_primary=6)
    with pytest.raises(ValueError, match=r"D in 1\.\.32"):
        composite(splats, torch.zeros(1, 5, 33, dtype=torch.float64), bins)
    with pytest.raises(ValueError, match=r"absgrad has shape \(1, 4, 2\); expected \(1, 5, 2\)"):
        composite(splats, channels, bins, marks=case.marks, num_primary=3, absgrad=case.absgrad[:, 1:])
    with pytest.raises(TypeError, match=r"channels is torch\.float32 and means2d is torch\.float64"):
        composite(splats, channels.float(), bins)
    with pytest.raises(TypeError, match="channels is on meta, but only the CPU"):
        composite(splats, channels.to("meta"), bins)
    with pytest.raises(TypeError, match="channels is on cpu and bins on meta"):
        composite(splats, channels, bins._replace(pair_splats=bins.pair_splats.to("meta")))
    fewer = Splats(*(tensor[:, :4] for tensor in splats))
    with pytest.raises(ValueError, match="bin these very splats"):
        composite(fewer, channels[:, :4], bins)
