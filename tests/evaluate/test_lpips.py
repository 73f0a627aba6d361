"""LPIPS on narrow random networks that are stored in the published key layout."""

from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from glassplat.data.errors import InputError
from glassplat.evaluate.lpips import LAYERS, Backbone, Lpips, load_lpips

WIDTHS = {"alex": (4, 6, 5, 5, 3), "vgg": (3, 4, 5, 4, 6, 5, 4, 3, 4, 5, 3, 4, 5)}
KERNELS = {"alex": (11, 5, 3, 3, 3), "vgg": (3,) * 13}
FILES = {"alex": ("alexnet-owt-7be5be79.pth", "alex.pth"), "vgg": ("vgg16-397923af.pth", "vgg.pth")}
SHIFT, SCALE = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])


@pytest.fixture(autouse=True)
def _nothing_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine's own weights must not leak into the tests."""
    monkeypatch.delenv("GLASSPLAT_LPIPS_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "empty_cache"))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)


def random_weights(backbone: Backbone) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The two files' contents: features with a stray classifier weight, and the linear weights."""
    generator = torch.Generator().manual_seed(7)
    features, linear, inputs = {"classifier.1.weight": torch.zeros(2, 2)}, {}, 3
    for layer, width, side in zip(LAYERS[backbone], WIDTHS[backbone], KERNELS[backbone], strict=True):
        scale = (2 / (inputs * side * side)) ** 0.5
        features[f"features.{layer.index}.weight"] = scale * torch.randn(width, inputs, side, side, generator=generator)
        features[f"features.{layer.index}.bias"] = 0.1 * torch.randn(width, generator=generator)
        if layer.tapped:
            linear[f"lin{len(linear)}.model.1.weight"] = torch.rand(1, width, 1, 1, generator=generator)
        inputs = width
    return features, linear


def write_weights(folder: Path, backbone: Backbone) -> Path:
    folder.mkdir(exist_ok=True)
    for name, weights in zip(FILES[backbone], random_weights(backbone), strict=True):
        torch.save(weights, folder / name)
    return folder


def torchvision_stack(backbone: Backbone, weights: dict[str, Tensor]) -> tuple[nn.Sequential, list[int]]:
    """The features as torchvision lays them out, and the positions of the ReLUs that LPIPS taps."""
    relu_taps = {"alex": [1, 4, 7, 9, 11], "vgg": [3, 8, 15, 22, 29]}[backbone]
    w = WIDTHS[backbone]
    if backbone == "alex":
        modules = [nn.Conv2d(3, w[0], 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(w[0], w[1], 5, padding=2)]
        modules += [nn.ReLU(), nn.MaxPool2d(3, 2)]
        for inputs, outputs in pairwise(w[1:]):
            modules += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
    else:
        modules, inputs, widths = [], 3, iter(w)
        for block in (2, 2, 3, 3, 3):
            for _ in range(block):
                outputs = next(widths)
                modules += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
                inputs = outputs
            modules += [nn.MaxPool2d(2, 2)]
    stack = nn.Sequential(*modules)
    names = {key.removeprefix("features."): value for key, value in weights.items() if key.startswith("features.")}
    stack.load_state_dict(names)
    return stack, relu_taps


def recomputed(backbone: Backbone, image: Tensor, target: Tensor) -> float:
    """The distance written out over torch modules, as the paper defines it."""
    features, linear = random_weights(backbone)
    stack, taps = torchvision_stack(backbone, features)
    total, pair = 0.0, [((2 * x - 1 - SHIFT) / SCALE).permute(2, 0, 1)[None] for x in (image, target)]
    for index, module in enumerate(stack):
        with torch.no_grad():
            pair = [module(x) for x in pair]
        if index in taps:
            unit = [nn.functional.normalize(x, dim=1) for x in pair]
            weight = linear[f"lin{taps.index(index)}.model.1.weight"]
            total += float(((unit[0] - unit[1]) ** 2 * weight).sum(1).mean())
    return total


def random_images() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(40, 52, 3, generator=generator)
    return image, (image + 0.2 * torch.randn(40, 52, 3, generator=generator)).clamp(0, 1)


@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_agrees_with_a_direct_computation(tmp_path: Path, backbone: Backbone) -> None:
    lpips = load_lpips(write_weights(tmp_path / "weights", backbone))
    image, target = random_images()
    assert lpips.backbone == backbone
    assert lpips(image, target) == pytest.approx(recomputed(backbone, image, target), rel=1e-4)
    assert lpips(image, target) > 0


@pytest.fixture
def alex(tmp_path: Path) -> Lpips:
    return load_lpips(write_weights(tmp_path / "weights", "alex"))


def test_is_zero_for_equal_images_and_symmetric(alex: Lpips) -> None:
    image, target = random_images()
    assert alex(image, image.clone()) == 0.0
    assert alex(image, target) == pytest.approx(alex(target, image), rel=1e-6)


def test_bytes_and_floats_mean_the_same(alex: Lpips) -> None:
    stored = [torch.round(image * 255) for image in random_images()]
    assert alex(*(s.to(torch.uint8) for s in stored)) == pytest.approx(alex(*(s / 255 for s in stored)), rel=1e-6)


def test_vgg_is_preferred_and_either_can_be_asked_for(tmp_path: Path) -> None:
    folder = tmp_path / "weights"
    write_weights(folder, "alex")
    write_weights(folder, "vgg")
    assert load_lpips(folder).backbone == "vgg"
    assert load_lpips(folder, "alex").backbone == "alex"


def test_the_environment_names_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLASSPLAT_LPIPS_WEIGHTS", str(write_weights(tmp_path / "weights", "alex")))
    assert load_lpips().backbone == "alex"


def test_features_from_the_hub_cache_go_with_linear_weights_from_the_folder(tmp_path: Path) -> None:
    folder = write_weights(tmp_path / "weights", "alex")
    cache = tmp_path / "empty_cache" / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    (folder / FILES["alex"][0]).rename(cache / FILES["alex"][0])
    assert load_lpips(folder).backbone == "alex"


def test_absent_weights_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"vgg16-\*\.pth with vgg\.pth or alexnet.*GLASSPLAT_LPIPS_WEIGHTS"):
        load_lpips()
    with pytest.raises(FileNotFoundError, match="is not a folder"):
        load_lpips(tmp_path / "nowhere")


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    folder = write_weights(tmp_path / "weights", "alex")
    linear = folder / "alex.pth"
    linear.write_bytes(linear.read_bytes()[:100])
    with pytest.raises(InputError, match=r"cannot read the weights in .*alex\.pth"):
        load_lpips(folder)


def test_files_of_two_backbones_do_not_mix(tmp_path: Path) -> None:
    folder = write_weights(tmp_path / "weights", "alex")
    torch.save(random_weights("vgg")[1], folder / "alex.pth")
    with pytest.raises(ValueError, match="channels differ"):
        load_lpips(folder)
    torch.save({}, folder / "alex.pth")
    with pytest.raises(ValueError, match="no weights named 'lin0"):
        load_lpips(folder)


def test_bad_images_are_refused(alex: Lpips) -> None:
    image, target = random_images()
    with pytest.raises(ValueError, match="of one size"):
        alex(image, target[1:])
    with pytest.raises(ValueError, match="at least 32 pixels"):
        alex(image[:20], target[:20])
