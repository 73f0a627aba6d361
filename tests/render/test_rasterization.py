"""`rasterization` renders images as gsplat defines them, forward and backward; here written out in float64."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import glassplat
from glassplat.errors import InputError

WIDTH, HEIGHT, COUNT, CAMERAS = 40, 28, 50, 2
NEAR, FAR = 0.5, 9.0
C0, C1 = 0.28209479177387814, 0.4886025119029199
NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")


def draws(seed: int, colors: tuple[int, ...], channels: int) -> dict[str, Tensor]:
    """A random scene and two cameras that look along z; parts of it are behind them, out of view or too far away."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(COUNT, 3, generator=generator, dtype=torch.float64)
    places = (uniform - torch.tensor([0.5, 0.5, 0.05])) * torch.tensor([5.0, 4.0, 10.0])
    viewmats = torch.eye(4, dtype=torch.float64).repeat(CAMERAS, 1, 1)
    angle = torch.tensor(0.3, dtype=torch.float64)
    viewmats[1, 0, 0] = viewmats[1, 2, 2] = angle.cos()
    viewmats[1, 0, 2], viewmats[1, 2, 0] = angle.sin(), -angle.sin()
    viewmats[1, :3, 3] = torch.tensor([0.2, -0.1, 0.4])
    return {
        "means": places,
        "quats": torch.randn(COUNT, 4, generator=generator, dtype=torch.float64),
        "scales": 0.05 + 0.5 * torch.rand(COUNT, 3, generator=generator, dtype=torch.float64),
        "opacities": 0.05 + 0.9 * torch.rand(COUNT, generator=generator, dtype=torch.float64),
        "colors": torch.randn(*colors, generator=generator, dtype=torch.float64),
        "viewmats": viewmats,
        "backgrounds": torch.rand(CAMERAS, channels, generator=generator, dtype=torch.float64),
    }


INTRINSICS = torch.tensor([[[30.0, 0, 21], [0, 33, 13], [0, 0, 1]]]).repeat(CAMERAS, 1, 1).double()


def rotations(quats: Tensor) -> Tensor:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def on_screen(of: dict[str, Tensor], camera: int, eps2d: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels [N, 2], covariances [N, 2, 2] with and without the added variance, depths [N]."""
    pose, lens = of["viewmats"][camera], INTRINSICS[camera]
    x, y, z = (of["means"] @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    axes = pose[:3, :3] @ rotations(of["quats"]) * of["scales"][:, None]
    fx, fy, cx, cy = lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2]
    # Outside the image by more than 0.3 of its half size, the Jacobian keeps its value at that border.
    u = (x / z).clamp(-(cx + 0.15 * WIDTH) / fx, (WIDTH - cx + 0.15 * WIDTH) / fx)
    v = (y / z).clamp(-(cy + 0.15 * HEIGHT) / fy, (HEIGHT - cy + 0.15 * HEIGHT) / fy)
    zero = torch.zeros_like(z)
    slope = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).reshape(-1, 2, 3)
    flat = slope @ axes
    plain = flat @ flat.mT
    return torch.stack([fx * x / z + cx, fy * y / z + cy], -1), plain + eps2d * torch.eye(2), plain, z


def harmonics(of: dict[str, Tensor], camera: int) -> Tensor:
    """[N, 3] colours of degree 1."""
    pose, sh = of["viewmats"][camera], of["colors"] if of["colors"].ndim == 3 else of["colors"][camera]
    eye = -pose[:3, :3].T @ pose[:3, 3]
    x, y, z = torch.nn.functional.normalize(of["means"] - eye, dim=-1)[..., None].unbind(-2)
    return (0.5 + C0 * sh[:, 0] + C1 * (-y * sh[:, 1] + z * sh[:, 2] - x * sh[:, 3])).clamp(min=0)


def defined(of: dict[str, Tensor], *, sh: bool, eps2d: float, antialiased: bool, depth: str) -> tuple[Tensor, Tensor]:
    """Images and coverage as gsplat's documentation defines them, every pixel against every Gaussian."""
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows], -1).double()
    images, alphas = [], []
    for camera in range(CAMERAS):
        means2d, wide, plain, depths = on_screen(of, camera, eps2d)
        opacities = of["opacities"]
        if antialiased:
            opacities = opacities * (plain.det() / wide.det()).sqrt()
        values = harmonics(of, camera) if sh else of["colors"].expand(CAMERAS, COUNT, -1)[camera]
        image, light = torch.zeros(HEIGHT, WIDTH, values.shape[1] + 1).double(), torch.ones(HEIGHT, WIDTH).double()
        open_ = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        for index in depths.argsort().tolist():
            if not NEAR < depths[index] < FAR:
                continue
            away = pixels - means2d[index]
            power = (away @ wide[index].inverse() * away).sum(-1) / 2
            alpha = (opacities[index] * (-power).exp()).clamp(max=0.99)
            open_ = open_ & ~((alpha >= 1 / 255) & (light * (1 - alpha) <= 1e-4))
            alpha = torch.where(open_ & (alpha >= 1 / 255), alpha, 0)
            image = image + (light * alpha)[..., None] * torch.cat([values[index], depths[index : index + 1]])
            light = light * (1 - alpha)
        coverage = 1 - light[..., None]
        colors = image[..., :-1] + light[..., None] * of["backgrounds"][camera]
        expected = image[..., -1:] / (coverage.clamp(min=1e-10) if depth.endswith("ED") else 1)
        images.append(torch.cat([colors, expected], -1) if "D" in depth else colors)
        alphas.append(coverage)
    return torch.stack(images), torch.stack(alphas)


CASES = [
    pytest.param((COUNT, 4, 3), 3, "RGB+ED", {"sh_degree": 1}, id="harmonics and expected depth"),
    pytest.param((CAMERAS, COUNT, 4, 3), 3, "RGB", {"sh_degree": 1}, id="harmonics of each camera"),
    pytest.param((COUNT, 3), 3, "RGB+D", {"eps2d": 0.1}, id="colours, depth, less blur"),
    pytest.param((CAMERAS, COUNT, 3), 3, "RGB", {"eps2d": 2.0}, id="colours of each camera, more blur"),
    pytest.param((COUNT, 4), 4, "RGB", {"rasterize_mode": "antialiased", "channel_chunk": 3}, id="antialiased chunks"),
]


@pytest.mark.parametrize(("shape", "channels", "mode", "options"), CASES)
def test_images_and_gradients_are_those_of_the_definition(shape, channels: int, mode: str, options: dict) -> None:
    exact = {name: value.requires_grad_() for name, value in draws(3, shape, channels).items()}
    ours = {name: value.detach().float().requires_grad_() for name, value in exact.items()}
    image, alpha, _ = glassplat.rasterization(
        **ours, Ks=INTRINSICS.float(), width=WIDTH, height=HEIGHT,
        near_plane=NEAR, far_plane=FAR, render_mode=mode, **options,
    )  # fmt: skip
    expected, coverage = defined(
        exact,
        sh="sh_degree" in options,
        eps2d=options.get("eps2d", 0.3),
        antialiased="rasterize_mode" in options,
        depth=mode,
    )
    assert coverage.min() < 0.01 and coverage.max() > 0.9
    torch.testing.assert_close(image.double(), expected, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(alpha.double(), coverage, atol=1e-4, rtol=1e-4)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    # The derivative of the expected depth is unbounded where coverage tends to zero.
    weights = weights * (coverage > 0.05)
    found = torch.autograd.grad((image * weights.float()).sum() + alpha.square().sum(), [ours[name] for name in NAMES])
    wanted = torch.autograd.grad((expected * weights).sum() + coverage.square().sum(), [exact[name] for name in NAMES])
    for name, one, other in zip(NAMES, found, wanted, strict=True):
        one, other = (grad[:, :3] if name == "viewmats" else grad for grad in (one, other))
        assert float((one.double() - other).norm() / other.norm()) < 1e-4, name


def plain(**changed) -> tuple[Tensor, Tensor, dict]:
    ours = {name: value.float() for name, value in draws(3, (COUNT, 3), 3).items() if name != "backgrounds"}
    return glassplat.rasterization(**{**ours, "Ks": INTRINSICS.float(), "width": WIDTH, "height": HEIGHT} | changed)


def test_depth_alone_is_the_last_channel_of_both() -> None:
    for alone in ("D", "ED"):
        both = plain(render_mode=f"RGB+{alone}")[0]
        torch.testing.assert_close(plain(render_mode=alone)[0], both[..., -1:])


def test_strategies_of_gsplat_find_what_they_read() -> None:
    means = draws(3, (COUNT, 3), 3)["means"].float().requires_grad_()
    image, _, meta = plain(means=means, absgrad=True)
    meta["means2d"].retain_grad()
    image.sum().backward()
    assert meta["radii"].shape == (CAMERAS, COUNT, 2) and meta["radii"].dtype == torch.int32
    seen = (meta["radii"] > 0).all(dim=-1)
    assert 0 < int(seen.sum()) < CAMERAS * COUNT
    assert bool((meta["means2d"].absgrad >= meta["means2d"].grad.abs() - 1e-5).all())
    assert not bool(meta["means2d"].grad[~seen].any()) and bool(meta["means2d"].grad[seen].any())


def test_opaque_and_flat_gaussians_are_drawn() -> None:
    drawn = draws(3, (COUNT, 3), 3)
    scales = drawn["scales"].float()
    scales[:, 2] = 0
    _, alpha, _ = plain(opacities=torch.ones(COUNT), scales=scales)
    assert float(alpha.max()) > 0.98


def test_gaussians_within_the_radius_clip_are_skipped() -> None:
    assert not bool(plain(radius_clip=1e4)[1].any())


@pytest.mark.parametrize("eps2d", [0.0, 0.3, 5.0, 10.0])
def test_radii_are_of_what_is_drawn(eps2d: float) -> None:
    """The second Gaussian lies 9 pixels to the left of the image."""
    only = {"quats": torch.tensor([[1.0, 0, 0, 0]] * 2), "scales": torch.full((2, 3), 0.05)}
    only |= {"means": torch.tensor([[0.0, 0, 4], [-4.0, 0, 4]]), "opacities": torch.full((2,), 0.5)}
    _, alpha, meta = plain(**only, colors=torch.ones(2, 3), eps2d=eps2d)
    variances = (0.05 * torch.tensor([30.0, 33.0]) / 4).square() + eps2d
    reach = (2 * math.log(0.5 * 255) * variances).sqrt()
    radii = reach.ceil().int().tolist()
    assert meta["radii"][0].tolist() == [radii, radii if reach[0] > 9 else [0, 0]]
    columns = (alpha[0, 13, 10:, 0] >= 1 / 255).sum()
    assert int(columns) == pytest.approx(2 * float(reach[0]), abs=1)
    assert bool(plain(**only, colors=torch.ones(2, 3), eps2d=eps2d, radius_clip=5.0)[1].any()) == (reach[0] > 5)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"camera_model": "fisheye"}, "expected pinhole"),
        ({"render_mode": "depth"}, r"expected one of RGB, D, ED"),
        ({"rasterize_mode": "sharp"}, "'sharp'; expected classic or antialiased"),
        ({"covars": torch.eye(3)}, "no covars here"),
        ({"with_ut": True}, "no with_ut here"),
        ({"colors": torch.rand(7, 3)}, r"\[7, 3\]; expected \[N, D\]"),
        ({"viewmats": torch.eye(4)}, r"expected \[C, 4, 4\]"),
        ({"backgrounds": torch.rand(3)}, r"\[3\]; expected \[2, 3\]"),
    ],
)
def test_unsupported_arguments_are_refused(changed: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        plain(**changed)


def test_a_size_may_be_any_integer_type() -> None:
    assert torch.equal(plain(width=torch.tensor(WIDTH))[0], plain()[0])
    with pytest.raises(TypeError, match="'float' object cannot be interpreted as an integer"):
        plain(height=float(HEIGHT))
