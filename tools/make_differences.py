"""Write the tables "What differs from the paper" on the pages of the methods, from the presets.

    python -m tools.make_differences

Each row is a recipe field whose value differs in `--preset paper`. This file holds only the reasons. A test checks that
the pages are up to date and that every difference has a reason.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from glassplat.methods.recipe import RECIPES, recipe_of

DOCS = Path(__file__).parent.parent / "docs"
BEGIN, END = "<!-- differences: begin -->", "<!-- differences: end -->"
COMMON = "splat"
"""Method whose page lists the differences shared by all methods."""

ALL = {
    "rates.short_run_power": "Short runs learn faster: by (30,000 / n)^0.5 in n >= 3,000 iterations; not opacities.",
    "intervals.averaged_passes": "The mean over the last pass scores higher than the last step.",
    "densify.split_by": "Gradients of single pixels (AbsGS) find what a large Gaussian smears.",
    "densify.whole_passes": "Every Gaussian is seen before it is judged.",
    "densify.adapt_to_size": "Without it, small photographs get more Gaussians than they have pixels.",
    "densify.prune_large_start": "Large Gaussians on walls and sky must stay.",
    "densify.per_pixel": "Inconsistent photographs would otherwise trigger densification without end.",
    "densify.least_contribution": "A sixth of the Gaussians contribute nothing.",
    "seed_unexplained": "A lamp in an open space has no points, and is found late or never.",
    "mcmc.noise_units": "The result does not depend on the units of the capture.",
    "mcmc.reach": "Without it, Gaussians that few views show fade and drift.",
    "mcmc.initial_spread": "Smaller ones take a thousand steps to close the gaps.",
}
GLOSSY = {
    "search.begin_found": "Finds mirrors whose reflection would stay baked in.",
    "search.estimated_normals": "Estimated normals tell which way a mirror faces.",
    "find_region": "From few views, anything looks reflective.",
    "strength_weight": "Without it, matte objects learn to reflect a little.",
    "consistency_weight": "Normals follow the slope of a coarse depth map, and are nearly right from the start.",
    "monocular_weight": "Estimated normals help little at the published weight.",
    "propagation.sabotage": "A round number.",
    "schedule.end": "Propagation ends when reflections stop growing.",
    "schedule.stop": "Only an upper bound.",
    "schedule.pause": "Runs are shorter.",
    "schedule.last_reset": "Raised opacities that merely occlude sink again.",
    "least_iterations": "Shorter runs train as `splat`, which is better for them.",
    "raise_rates_matte": "Without mirrors there are no normals to spoil.",
    "raise_rates_found": "Without it, matte parts lose half a decibel.",
    "bootstrap": "Mirrors are recognised by their look before they reflect.",
    "rates.decay": "Positions slow down until the end of the run.",
    "reflection_rates.strength": "Runs are shorter.",
    "intervals.opacity": "Mirrors would lose strength while propagation waits.",
    "intervals.reset_stop": "As in 3DGS.",
    "intervals.sh": "As in 3DGS.",
    "densify.start": "As in 3DGS.",
    "densify.stop": "As in 3DGS.",
    "densify.prune_large_start": ALL["densify.prune_large_start"],
    "densify.prune_opacity": "As in 3DGS.",
}
REASONS: dict[str, dict[str, str]] = {
    "splat": ALL,
    "planar": {
        "view_dependence_weight": "Mirrored views see Gaussians from directions that no photograph shows.",
        "stage_shares": "The first two stages have at most 350 steps: the longer panes are missing, the more Gaussians "
        "model reflections behind them.",
        "fresnel": "A pane has two surfaces; Schlick's curve is a third too low at 70°.",
        "blend": "Light adds up linearly.",
        "panes": "Panes behind panes caused half of the error of a glass case.",
        "detect_mirrors": "Mirrors need not be labelled by hand.",
        "fixed_mirrors": "Otherwise R0 falls, and the mirror becomes a window.",
        "seed_reflections": "Captures from the front show the room only in the glass.",
        "turn_reflections": "What the first stage built behind glass would stay there, and R0 would be too low.",
        "weights.reflectance": "Where no photograph shows what is mirrored, its brightness and R0 are ambiguous.",
        "plane_fit.glass_reflectance": "That of clear glass: from 0.2, reflections begin too bright.",
        "weights.intensity": "R0 and the reflection intensity a are nearly interchangeable.",
        "conflict": "Per pixel, most matches are edges that coincide by chance.",
        "moving_mean": "Gaussians move towards the mean depth, and outliers do not pull the mean.",
        "perturbation.stop": "Perturbed opacities need time to settle.",
        "perturbation.bounds": "Opacities that were lowered by mistake can recover.",
        "early_resets": "Otherwise planes are fitted to transparent Gaussians: -1.1 dB.",
        "densify_by": "Summed gradients of direct and mirrored views hide each other's detail.",
    },
    "deferred": GLOSSY
    | {
        "texels": "Runs are shorter.",
        "first_texels": "Coarse texels give wrong normals a gradient.",
        "propagation_interval": "`densify.interval` is kept: runs are shorter.",
    },
    "traced": GLOSSY
    | {
        "primitive": "Discs are 0.1 to 1.1 dB worse.",
        "sh_degree": "As in 3DGS.",
        "harmonics_from_start": "View-dependent colours would explain reflections.",
        "mirrors": "A cube map finds the sky sooner, and normals with it.",
        "least_strength": "Most pixels reflect nothing; skipping them costs 0.00 dB.",
        "surroundings.start.source": "The scene already holds what is mirrored; it takes a third of the time.",
        "surroundings.start.cells": "At most 32, with half a Gaussian per pixel.",
        "surroundings.sh_degree": "Most mirrored objects are matte.",
        "surroundings.rates.decay": "Runs are shorter.",
        "surroundings.rates.short_run_power": "Runs are shorter.",
        "surroundings.densify.interval": "As for the scene.",
        "surroundings.densify.whole_passes": "As for the scene.",
        "surroundings.densify.adapt_to_size": "As for the scene.",
        "surroundings.densify.start": "As for the scene.",
        "surroundings.densify.stop": "Runs are shorter.",
        "surroundings.densify.gradient_threshold": "As for the scene.",
        "surroundings.densify.prune_opacity": "As for the scene.",
        "surroundings.densify.prune_large_start": "As for the scene.",
        "surroundings.densify.cap": "As for the scene, `densify.per_pixel` decides.",
        "surroundings.densify.per_pixel": "As for the scene.",
        "surroundings.densify.least_contribution": "Late in the run, what no reflection shows is pruned.",
        "surroundings.reset": "Copies start in the right place.",
        "normals_throughout": "Later, depths are too noisy: -0.25 to -1 dB.",
    },
}
"""Reasons for differences, by method and dotted field name."""


def leaves(options: Any, name: str = "") -> dict[str, Any]:
    """All leaf values of nested options, by dotted name."""
    if not dataclasses.is_dataclass(options):
        return {name: options}
    parts = [
        leaves(getattr(options, field.name), f"{name}.{field.name}".lstrip("."))
        for field in dataclasses.fields(options)
    ]
    return {key: value for part in parts for key, value in part.items()}


def differences(method: str) -> dict[str, tuple[Any, Any]]:
    """Default and published value of every field in which they differ."""
    ours, published = leaves(recipe_of(method)), leaves(recipe_of(method, "paper"))
    return {name: (value, published[name]) for name, value in ours.items() if value != published[name]}


def written(value: Any) -> str:
    """A value formatted for the table; None stands for a value that the method works out."""
    if value is None:
        return "automatic"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple):
        return ", ".join(written(part) for part in value)
    return str(value)


def own_differences(method: str) -> dict[str, tuple[Any, Any]]:
    """Differences of a method, without those shared by all methods."""
    shared = differences(COMMON) if method != COMMON else {}
    return {name: values for name, values in differences(method).items() if shared.get(name) != values}


def table_of(method: str) -> str:
    """Table of a method, without the rows shared by all methods."""
    rows = [
        f"| `{name}` | {written(ours)} | {written(published)} | {REASONS[method][name]} |"
        for name, (ours, published) in own_differences(method).items()
    ]
    return "\n".join(["| field | here | paper | why |", "|---|---|---|---|", *rows])


def with_table(page: str, method: str) -> str:
    """The text of a page with its table replaced by that of the presets."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"docs/{method}.md has no place for the table: {BEGIN} and {END}")
    return f"{before}{BEGIN}\n{table_of(method)}\n{END}{after}"


def main() -> None:
    """Write the tables of all methods."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    for method in RECIPES:
        page = DOCS / f"{method}.md"
        page.write_text(with_table(page.read_text(encoding="utf-8"), method), encoding="utf-8")


if __name__ == "__main__":
    main()
