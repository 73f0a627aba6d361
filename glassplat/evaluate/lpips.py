"""LPIPS, the learned perceptual distance, from weight files that other packages publish.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric" (CVPR 2018). Two files
are needed per backbone: the features of torchvision's classifier (`vgg16-397923af.pth`,
`alexnet-owt-7be5be79.pth`) and the linear weights of the `lpips` package, version 0.1 (`vgg.pth`, `alex.pth`).
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Literal, get_args

import torch
from torch import Tensor

from glassplat.data.errors import InputError

Backbone = Literal["vgg", "alex"]
WEIGHTS_VARIABLE = "GLASSPLAT_LPIPS_WEIGHTS"
SMALLEST_SIDE = 32


@dataclass(frozen=True)
class Convolution:
    """One convolution, followed by a ReLU.

    Attributes:
        index: position in torchvision's `features`, which names its weights.
        stride: of the convolution.
        padding: of the convolution.
        pool: side of the max pooling in front of it (stride 2); 0 for none.
        tapped: whether the distance looks at what comes out.
    """

    index: int
    stride: int = 1
    padding: int = 1
    pool: int = 0
    tapped: bool = True


LAYERS: Mapping[Backbone, tuple[Convolution, ...]] = {
    "vgg": (
        Convolution(0, tapped=False),
        Convolution(2),
        Convolution(5, pool=2, tapped=False),
        Convolution(7),
        Convolution(10, pool=2, tapped=False),
        Convolution(12, tapped=False),
        Convolution(14),
        Convolution(17, pool=2, tapped=False),
        Convolution(19, tapped=False),
        Convolution(21),
        Convolution(24, pool=2, tapped=False),
        Convolution(26, tapped=False),
        Convolution(28),
    ),
    "alex": (
        Convolution(0, stride=4, padding=2),
        Convolution(3, padding=2, pool=3),
        Convolution(6, pool=3),
        Convolution(8),
        Convolution(10),
    ),
}
FILE_PATTERNS: Mapping[Backbone, tuple[str, str]] = {
    "vgg": ("vgg16-*.pth", "vgg.pth"),
    "alex": ("alexnet-*.pth", "alex.pth"),
}
"""Where the features and the linear weights are found in a folder."""


@dataclass(frozen=True)
class Lpips:
    """The distance with one backbone.

    Attributes:
        backbone: which network; a value without it means nothing.
        features: weight and bias of each convolution in `LAYERS`.
        linear: [1, C, 1, 1] non-negative weight of each channel, one tensor per tapped convolution.
    """

    backbone: Backbone
    features: tuple[tuple[Tensor, Tensor], ...]
    linear: tuple[Tensor, ...]

    def __call__(self, image: Tensor, target: Tensor) -> float:
        """The distance of two sRGB images [H, W, 3], uint8 or floating point in [0, 1].

        Images enter the network scaled to [-1, 1], as the authors define it. (3DGS's own script feeds
        [0, 1], so its published numbers differ slightly.)

        Raises:
            ValueError: shapes disagree, or a side is shorter than 32 pixels.
        """
        if image.shape != target.shape or image.ndim != 3 or image.shape[-1] != 3:
            raise ValueError(
                f"expected two images [H, W, 3] of one size, got {list(image.shape)}, {list(target.shape)}"
            )
        if min(image.shape[:2]) < SMALLEST_SIDE:
            raise ValueError(f"LPIPS needs at least {SMALLEST_SIDE} pixels a side, got {list(image.shape[:2])}")
        with torch.no_grad():
            pairs = zip(self._taps(image), self._taps(target), self.linear, strict=True)
            return sum(float(((a - b).square() * weight).sum(dim=1).mean()) for a, b, weight in pairs)

    def _taps(self, image: Tensor) -> list[Tensor]:
        """Channel-normalised activations [1, C, h, w] of the tapped convolutions."""
        x = _network_input(image)
        taps = []
        for layer, (weight, bias) in zip(LAYERS[self.backbone], self.features, strict=True):
            if layer.pool:
                x = torch.nn.functional.max_pool2d(x, layer.pool, stride=2)
            x = torch.relu(torch.nn.functional.conv2d(x, weight, bias, stride=layer.stride, padding=layer.padding))
            if layer.tapped:
                taps.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
        return taps


def load_lpips(folder: Path | None = None, backbone: Backbone | None = None) -> Lpips:
    """Loads the distance from local weight files; nothing is downloaded.

    Looks in `folder`, else in the folder that the environment variable GLASSPLAT_LPIPS_WEIGHTS names, and
    after that in torch's hub cache and in an installed `lpips` package.

    Args:
        folder: a folder with the files.
        backbone: `vgg` (which splatting papers report) or `alex`; None takes the first that is there.

    Raises:
        FileNotFoundError: the files are not there; the message says which and where they may be put.
        InputError: a file is damaged or holds something else.
    """
    folders = _search_folders(folder)
    wanted = get_args(Backbone) if backbone is None else (backbone,)
    for name in wanted:
        paths = [_first_match(pattern, folders) for pattern in FILE_PATTERNS[name]]
        if paths[0] is not None and paths[1] is not None:
            return _load_pair(name, paths[0], paths[1])
    needed = " or ".join(" with ".join(FILE_PATTERNS[name]) for name in wanted)
    places = ", ".join(str(place) for place in folders)
    raise FileNotFoundError(
        f"no LPIPS weights: expected {needed} in {places}; put torchvision's and the lpips package's files into a "
        f"folder and name it in {WEIGHTS_VARIABLE}"
    )


def _search_folders(folder: Path | None) -> list[Path]:
    named = folder or (Path(os.environ[WEIGHTS_VARIABLE]) if os.environ.get(WEIGHTS_VARIABLE) else None)
    if named is not None and not named.is_dir():
        raise FileNotFoundError(f"no LPIPS weights: {named} is not a folder; give the folder that holds the .pth files")
    found = [named] if named is not None else []
    found.append(Path(torch.hub.get_dir()) / "checkpoints")
    package = importlib.util.find_spec("lpips")
    if package is not None and package.origin is not None:
        found.append(Path(package.origin).parent / "weights" / "v0.1")
    return found


def _first_match(pattern: str, folders: list[Path]) -> Path | None:
    return next((path for folder in folders for path in sorted(folder.glob(pattern))), None)


def _load_pair(backbone: Backbone, features_path: Path, linear_path: Path) -> Lpips:
    """Reads both files and checks that they belong together."""
    features, linear = _load_weights(features_path), _load_weights(linear_path)
    layers = LAYERS[backbone]
    taps = sum(layer.tapped for layer in layers)
    pairs = [
        (_taken(features, f"features.{i}.weight", features_path), _taken(features, f"features.{i}.bias", features_path))
        for i in (layer.index for layer in layers)
    ]
    weights = [_taken(linear, f"lin{tap}.model.1.weight", linear_path) for tap in range(taps)]
    outputs = [pair[0].shape[0] for pair, layer in zip(pairs, layers, strict=True) if layer.tapped]
    if outputs != [weight.shape[1] for weight in weights]:
        raise InputError(
            f"{linear_path} does not belong to {features_path}: channels differ; use files of one backbone"
        )
    return Lpips(backbone, tuple(pairs), tuple(weights))


def _load_weights(path: Path) -> Mapping[str, Tensor]:
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, UnpicklingError, EOFError) as error:
        raise InputError(f"cannot read the weights in {path}; the file is damaged: download it again") from error
    if not isinstance(weights, dict):
        raise InputError(f"{path} holds {type(weights).__name__}; expected a dictionary of named weights")
    return weights


def _taken(weights: Mapping[str, Tensor], key: str, path: Path) -> Tensor:
    if key not in weights:
        raise InputError(f"{path} has no weights named {key!r}; expected the published file of that name")
    return weights[key].to(torch.float32)


def _network_input(image: Tensor) -> Tensor:
    """[1, 3, H, W], normalised as the networks were trained; the constants are LPIPS's scaling layer."""
    x = image.to(torch.float32) / 255 if image.dtype == torch.uint8 else image.detach().to(torch.float32)
    shift = torch.tensor([-0.030, -0.088, -0.188], device=x.device)
    scale = torch.tensor([0.458, 0.448, 0.450], device=x.device)
    return (((2 * x - 1) - shift) / scale).permute(2, 0, 1)[None]
