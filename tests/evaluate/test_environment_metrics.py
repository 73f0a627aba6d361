import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from glassplat.errors import InputError
from glassplat.evaluate.metrics import (
    environment_metrics,
    learned_environment,
    psnr,
    true_environment,
)
from glassplat.files.sidecars import write_equirect
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Environment, Scene

TRUTH = 0.1 + 0.6 * torch.rand(64, 128, 3, generator=torch.Generator().manual_seed(0))


def mean_difference(image: torch.Tensor, target: torch.Tensor) -> float:
    """Stands in for LPIPS."""
    assert image.dtype == target.dtype == torch.uint8
    return float((image.double() - target.double()).abs().mean())


def environment_psnr(learned: torch.Tensor, truth: torch.Tensor) -> tuple[Any, Any]:
    """PSNR and gain of an environment."""
    found = environment_metrics(learned, truth, "no weights")
    return found["environment_psnr"], found["environment_gain"]


def test_equal_maps_up_to_a_factor_have_no_error() -> None:
    value, gain = environment_psnr(0.4 * TRUTH, TRUTH)
    assert value == math.inf
    assert gain == pytest.approx(2.5)


def test_a_difference_that_keeps_the_energy_is_that_of_the_images() -> None:
    stripes = torch.where(torch.arange(128)[:, None] % 2 == 0, 0.05, -0.05)
    value, gain = environment_psnr(TRUTH + stripes, TRUTH)
    assert gain == pytest.approx(1.0, abs=1e-6)
    assert value == pytest.approx(psnr(TRUTH + stripes, TRUTH), abs=0.05)


def test_rows_count_by_their_solid_angle() -> None:
    grey = torch.full((64, 128, 3), 0.5)
    stripe = torch.where(torch.arange(128)[:, None] % 2 == 0, 0.2, -0.2)
    at_pole, at_equator = grey.clone(), grey.clone()
    at_pole[0] += stripe
    at_equator[32] += stripe
    difference = environment_psnr(at_pole, grey)[0] - environment_psnr(at_equator, grey)[0]
    ratio = math.cos(math.pi / 2 - math.pi / 128) / math.cos(math.pi / 128)
    assert difference == pytest.approx(-10 * math.log10(ratio), abs=1e-3)


def test_the_energy_too_is_that_of_the_sphere() -> None:
    bright_pole, grey = torch.full((64, 128, 3), 0.5), torch.full((64, 128, 3), 0.5)
    bright_pole[0] = 1.0
    assert 0.999 < environment_psnr(bright_pole, grey)[1] < 1


def test_a_larger_truth_is_averaged_down() -> None:
    large = TRUTH.repeat_interleave(4, dim=0).repeat_interleave(4, dim=1)
    assert environment_psnr(TRUTH, large)[0] == math.inf


def test_black_maps() -> None:
    value, gain = environment_psnr(torch.zeros(64, 128, 3), TRUTH)
    assert gain == 1.0 and 0 < value < 20
    assert environment_psnr(TRUTH, torch.zeros(64, 128, 3)) == (math.inf, 0.0)


def test_values_that_are_not_finite_are_refused() -> None:
    broken = TRUTH / 0
    for learned, truth, name in ((broken, TRUTH, "learned"), (TRUTH, broken, "true")):
        with pytest.raises(ValueError, match=f"the {name} environment contains non-finite values"):
            environment_psnr(learned, truth)


def test_lpips_sees_equalised_maps() -> None:
    assert environment_metrics(0.4 * TRUTH, TRUTH, mean_difference)["environment_lpips"] == 0
    assert environment_metrics(TRUTH.flip(0), TRUTH, mean_difference)["environment_lpips"] > 1
    assert environment_metrics(TRUTH, TRUTH, "no LPIPS: install it")["environment_lpips"] == "no LPIPS"


def test_the_reason_names_what_is_missing() -> None:
    names = {"environment_psnr", "environment_gain", "environment_lpips"}
    found = environment_metrics(0.5 * TRUTH, TRUTH, "no weights")
    assert set(found) == names
    assert found["environment_gain"] == pytest.approx(2.0)
    assert environment_metrics(None, TRUTH, "no weights") == dict.fromkeys(names, "the method learns no environment")
    assert environment_metrics(TRUTH, None, "") == dict.fromkeys(names, "the data set has no true environment")


@pytest.mark.parametrize("suffix", [".exr", ".png"])
def test_a_capture_may_ship_its_environment(tmp_path: Path, suffix: str) -> None:
    assert true_environment(tmp_path) is None
    panorama = torch.rand(8, 16, 3)
    write_equirect(tmp_path / f"environment{suffix}", panorama)
    found = true_environment(tmp_path)
    assert found is not None
    torch.testing.assert_close(found, panorama, atol=1 / 255, rtol=0)


def test_a_broken_environment_is_named(tmp_path: Path) -> None:
    (tmp_path / "environment.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"environment\.png"):
        true_environment(tmp_path)


def test_a_scene_with_a_known_environment_matches_it() -> None:
    scene = Scene(Gaussians.empty(1), extent=1.0)
    assert learned_environment(scene) is None
    environment = Environment.random(8, generator=torch.Generator().manual_seed(0))
    learned = learned_environment(replace(scene, environment=environment))
    assert learned is not None
    metrics = environment_metrics(learned, learned, "no weights")
    assert metrics["environment_gain"] == pytest.approx(1.0)
