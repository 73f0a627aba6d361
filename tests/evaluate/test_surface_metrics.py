import math

import pytest
import torch

from glassplat.evaluate.metrics import angular_errors_deg, surface_metrics
from glassplat.evaluate.truth import TrueSurface
from glassplat.render.frame import Frame

HEIGHT, WIDTH = 20, 30
NORMALS = torch.tensor([0.6, 0.0, 0.8]).expand(HEIGHT, WIDTH, 3)
COVERED = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
COVERED[2:18, 5:25] = True
STRENGTH = torch.where(torch.arange(WIDTH) < 15, 0.9, 0.2).expand(HEIGHT, WIDTH)
TRUTH = TrueSurface(COVERED, NORMALS * COVERED[..., None], STRENGTH)
PHOTO = torch.full((HEIGHT, WIDTH, 3), 255, dtype=torch.uint8)
NOT_BESIDE = "there is no true strength for the photograph"


def frame(**layers: torch.Tensor) -> Frame:
    return Frame(torch.zeros(HEIGHT, WIDTH, 3), layers)


def turned(angle_deg: float) -> torch.Tensor:
    """The true normals rotated about y, and shortened as by blending."""
    angle = math.radians(angle_deg) + math.atan2(0.6, 0.8)
    return 0.7 * torch.tensor([math.sin(angle), 0.0, math.cos(angle)]).expand(HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("angle_deg", [0.0, 0.01, 5.0, 90.0, 179.0])
def test_normals_are_compared_whatever_their_length(angle_deg: float) -> None:
    metrics = surface_metrics(frame(normal=turned(angle_deg)), PHOTO, TRUTH)
    assert metrics["normal_error_deg"] == pytest.approx(angle_deg, abs=1e-4)
    assert metrics["reflective_normal_error_deg"] == pytest.approx(angle_deg, abs=1e-4)


def test_only_covered_pixels_count_and_reflective_ones_apart() -> None:
    normal = torch.where((STRENGTH > 0.5)[..., None], turned(10.0), turned(30.0))
    normal = torch.where(COVERED[..., None], normal, turned(120.0))
    metrics = surface_metrics(frame(normal=normal), PHOTO, TRUTH)
    assert metrics["normal_error_deg"] == pytest.approx(20.0, abs=1e-4)
    assert metrics["reflective_normal_error_deg"] == pytest.approx(10.0, abs=1e-4)


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_a_normal_without_direction_counts_as_90_degrees_off(value: float) -> None:
    normal = turned(0.0).clone()
    normal[2:10] = value
    assert surface_metrics(frame(normal=normal), PHOTO, TRUTH)["normal_error_deg"] == pytest.approx(45.0, abs=1e-4)


def test_angles_of_tiny_vectors() -> None:
    vectors = torch.tensor([[1e-20, 0.0, 0.0], [0.0, 0.0, 1e-20], [0.0, -3e4, 0.0]])
    truth = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert angular_errors_deg(vectors, truth).tolist() == pytest.approx([0.0, 90.0, 180.0])


def test_strength_error_is_absolute_and_of_the_covered_pixels() -> None:
    offset = torch.where(torch.arange(HEIGHT)[:, None] < 10, 0.05, -0.05)
    rendered = torch.where(COVERED, STRENGTH + offset, 1.0)
    assert surface_metrics(frame(strength=rendered), PHOTO, TRUTH)["strength_error"] == pytest.approx(0.05, abs=1e-6)


def test_the_reason_names_what_is_missing() -> None:
    both = frame(normal=turned(1.0), strength=STRENGTH)
    assert surface_metrics(frame(), PHOTO, TRUTH) == {
        "reflective_psnr": pytest.approx(0.0),
        "normal_error_deg": "the method renders no normals",
        "reflective_normal_error_deg": "the method renders no normals",
        "strength_error": "the method renders no strength",
    }
    unknown = "there are no true normals for the photograph"
    assert surface_metrics(frame(), PHOTO, None)["normal_error_deg"] == unknown
    assert surface_metrics(both, PHOTO, None) == {
        "reflective_psnr": NOT_BESIDE,
        "normal_error_deg": unknown,
        "reflective_normal_error_deg": unknown,
        "strength_error": NOT_BESIDE,
    }
    without_strength = surface_metrics(both, PHOTO, TrueSurface(COVERED, TRUTH.normals, None))
    assert without_strength["normal_error_deg"] == pytest.approx(1.0, abs=1e-4)
    assert without_strength["reflective_normal_error_deg"] == without_strength["strength_error"] == NOT_BESIDE


def test_the_image_is_measured_where_it_is_a_reflection() -> None:
    image = torch.where((COVERED & (STRENGTH > 0.5))[..., None], 0.9, 0.0).expand(HEIGHT, WIDTH, 3)
    metrics = surface_metrics(Frame(image), PHOTO, TRUTH)
    assert metrics["reflective_psnr"] == pytest.approx(20.0, abs=0.2)


def test_mask_slivers_are_ignored() -> None:
    both = frame(normal=turned(1.0), strength=STRENGTH)
    sliver = TrueSurface(COVERED & (torch.arange(WIDTH) < 6), TRUTH.normals, STRENGTH)
    assert surface_metrics(both, PHOTO, sliver)["normal_error_deg"] == "fewer than 100 pixels show a surface"
    matt = TrueSurface(COVERED, TRUTH.normals, torch.zeros_like(STRENGTH))
    assert (
        surface_metrics(both, PHOTO, matt)["reflective_normal_error_deg"]
        == "fewer than 100 pixels reflect more than half"
    )
