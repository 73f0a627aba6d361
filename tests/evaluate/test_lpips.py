"""LPIPS: the inputs of torchmetrics, and the reason given when the metric is unavailable."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import Tensor

from glassplat.evaluate.evaluate import _lpips
from glassplat.evaluate.metrics import LPIPS_BACKBONE, load_lpips

MODULE = "torchmetrics.image.lpip"


def with_metric(monkeypatch: pytest.MonkeyPatch, metric: object) -> None:
    """Stands in for torchmetrics, whose network needs downloaded weights."""
    for name in ("torchmetrics", "torchmetrics.image", MODULE):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules[MODULE].LearnedPerceptualImagePatchSimilarity = metric  # type: ignore[attr-defined]


def mean_difference(image: Tensor, target: Tensor) -> Tensor:
    assert image.shape == target.shape and image.shape[:2] == (1, 3)
    assert float(image.min()) >= 0 and float(image.max()) <= 1
    return (image - target).abs().mean()


def test_images_enter_as_batches_between_0_and_1(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, object] = {}
    with_metric(monkeypatch, lambda **options: asked.update(options) or mean_difference)
    lpips = load_lpips()
    assert not isinstance(lpips, str) and LPIPS_BACKBONE == "vgg"
    assert asked == {"net_type": "vgg", "normalize": True}  # `normalize` declares that images are in [0, 1].
    white, grey = torch.full((32, 40, 3), 255, dtype=torch.uint8), torch.full((32, 40, 3), 51, dtype=torch.uint8)
    assert lpips(white, grey) == pytest.approx(0.8)


def test_views_that_are_too_small_have_a_reason_and_no_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    with_metric(monkeypatch, lambda **options: mean_difference)
    small, large = torch.zeros(31, 40, 3), torch.zeros(40, 40, 3)
    assert _lpips(load_lpips(), small, small) == "views of fewer than 32 pixels a side"
    assert _lpips(load_lpips(), large, large) == 0
    assert _lpips(load_lpips(), large + 1, large + 1.5) == 0, "what is brighter than white is white"


def test_missing_torchmetrics_is_reported_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    assert load_lpips() == "pip install 'glassplat[lpips]'"


@pytest.mark.parametrize("error", [RuntimeError("operator torchvision::nms does not exist"), OSError("no network")])
def test_the_import_error_of_torchmetrics_is_the_reason(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**options: object) -> None:
        raise error

    with_metric(monkeypatch, fail)
    monkeypatch.setitem(sys.modules, "torchvision", ModuleType("torchvision"))
    assert load_lpips() == f"torchmetrics cannot load it: {error}"


@pytest.mark.parametrize(
    ("build", "index"), [("+cpu", " --index-url https://download.pytorch.org/whl/cpu"), ("", "")], ids=["cpu", "pypi"]
)
def test_a_torchvision_of_another_build_is_named_with_the_remedy(
    build: str, index: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(**options: object) -> None:
        raise RuntimeError("operator torchvision::nms does not exist")

    (tmp_path / "torchvision.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    (tmp_path / "torchvision-0.1.dist-info").mkdir()
    (tmp_path / "torchvision-0.1.dist-info" / "METADATA").write_text("Name: torchvision\nVersion: 0.1\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "torchvision", raising=False)
    monkeypatch.setattr(torch, "__version__", f"2.9.0{build}")
    with_metric(monkeypatch, fail)
    assert load_lpips() == (
        f"torchvision 0.1 is of another build than PyTorch 2.9.0{build}: pip uninstall torchvision, "
        f"then pip install torchvision torch==2.9.0{index}"
    )
