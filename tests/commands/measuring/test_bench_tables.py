"""Tables of hand-made results."""

from __future__ import annotations

from typing import Any

import pytest

from glassplat.commands.measuring.bench_tables import (
    Measured,
    Pair,
    Spread,
    differences,
    differences_table,
    means,
    means_table,
    plain_rows,
    values_of,
)

PAIR = Pair("planar - splat", "planar", "splat")


def measured(scene: str, variant: str, seed: int, **values: float | None) -> Measured:
    return Measured(scene, variant, seed, values_of({"planes": [], **values}))


def two_scenes() -> list[Measured]:
    return [
        measured("room", "splat", 0, psnr=30.0, num_gaussians=1000),
        measured("room", "planar", 0, psnr=31.0, num_gaussians=900, transmission_psnr=20.0),
        measured("room", "splat", 1, psnr=30.2, num_gaussians=1000),
        measured("room", "planar", 1, psnr=31.6, num_gaussians=800, transmission_psnr=22.0),
        measured("hall", "splat", 0, psnr=25.0, num_gaussians=500),
        measured("hall", "planar", 0, psnr=28.0, num_gaussians=500),
        measured("hall", "splat", 1, psnr=25.0, num_gaussians=500),
        measured("hall", "planar", 1, psnr=29.0, num_gaussians=250),
    ]


def test_plane_errors_are_means_over_the_planes() -> None:
    planes: list[dict[str, Any]] = [
        {"normal_error_deg": 0.2, "offset_error": 0.01, "base_reflectance_error": None},
        {"normal_error_deg": 0.4, "offset_error": 0.03, "base_reflectance_error": None},
    ]
    values = values_of({"psnr": 30.0, "normal_error_deg": 7.0, "planes": planes})
    assert values["pane_normal_error_deg"] == pytest.approx(0.3)
    assert values["normal_error_deg"] == 7.0
    assert values["offset_error"] == pytest.approx(0.02)
    assert values["base_reflectance_error"] is None
    assert values["psnr"] == 30.0 and values["ssim"] is None


def test_means_with_their_spread_over_seeds() -> None:
    rows = means(two_scenes())
    assert [(row.scene, row.title) for row in rows] == [
        ("room", "splat"),
        ("room", "planar"),
        ("hall", "splat"),
        ("hall", "planar"),
    ]
    assert rows[1].values["psnr"] == (pytest.approx(31.3), pytest.approx(0.4243, abs=1e-4), 2)
    assert rows[0].values["transmission_psnr"] is None


def test_differences_are_taken_seed_by_seed() -> None:
    room, hall, mean = differences(two_scenes(), [PAIR])
    assert room.values["psnr"] == (pytest.approx(1.2), pytest.approx(0.2828, abs=1e-4), 2)
    assert hall.values["num_gaussians"] == (pytest.approx(0.75), pytest.approx(0.3536, abs=1e-4), 2)
    assert room.values["transmission_psnr"] is None
    assert (mean.scene, mean.title) == ("mean", "planar - splat")
    assert mean.values["psnr"] == (pytest.approx((2.0 + 2.7) / 2), pytest.approx(0.4950, abs=1e-4), 2)


def test_a_seed_that_only_one_variant_has_is_left_out() -> None:
    (row,) = differences(two_scenes()[:3], [PAIR])
    assert row.values["psnr"] == Spread(1.0, None, 1)
    assert differences(two_scenes()[:1], [PAIR]) == []


def test_markdown() -> None:
    lines = means_table(means(two_scenes()), "Scenes", "A note.").markdown().splitlines()
    assert lines[:3] == ["### Scenes", "", "A note."]
    assert "| scene | variant | psnr | transmission psnr | Gaussians |" in lines
    assert "| room | splat | 30.10 ± 0.14 | - | 1000 ± 0 |" in lines
    table = differences_table(differences(two_scenes(), [PAIR]), "Differences").markdown()
    assert "| scene | variant | psnr | Gaussians, ratio |" in table
    assert "| room | planar - splat | +1.20 ± 0.28 | 0.850 ± 0.071 |" in table


def test_rows_for_json() -> None:
    (row,) = plain_rows(differences(two_scenes()[:2], [PAIR]))
    assert row["scene"] == "room" and row["title"] == "planar - splat"
    assert row["psnr"] == {"mean": 1.0, "deviation": None, "seeds": 1}
    assert row["ssim"] is None
