"""`glassplat bench`: methods over scenes, and what each part of a method is worth."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.commands.console.messages import message_console, say
from glassplat.commands.measuring.bench_runs import (
    RUNS,
    FinishedRun,
    PlannedRun,
    earlier_runs,
    say_captures,
    scene_names,
)
from glassplat.commands.measuring.bench_seconds import BenchSeconds, Method
from glassplat.commands.measuring.bench_tables import (
    Measured,
    Pair,
    Row,
    differences,
    differences_table,
    means,
    means_table,
    plain_rows,
    values_of,
)
from glassplat.commands.runs.output_folder import check_targets
from glassplat.commands.training.train import Train
from glassplat.data.errors import InputError
from glassplat.data.masks import Polarity
from glassplat.data.ranges import Downscale, Seed, Several
from glassplat.files.folders import check_folder, real_path
from glassplat.train.ablations import ABLATIONS, Ablated, Ablation, Switch
from glassplat.train.recipe import RECIPES, Preset, recipe_of
from glassplat.train.run_directory import write_text

Strategy = Literal["default", "mcmc"]
FULL = "full"
TABLES = ("scenes.md", "scenes.json", "ablation.md", "ablation.json")
SPREAD_NOTE = "Means over the seeds ± their standard deviation."
COMPARED_NOTE = (
    "Seed against equal seed; counts and times as quotients. `mean` is over the scenes that have a value. "
    + SPREAD_NOTE
)


@dataclass(frozen=True)
class BenchScenes:
    """Train and evaluate methods on scenes and write one table; repeat the command to go on after an interrupt.

    Attributes:
        data: directories of the captures.
        output: where the tables and one directory per run go.
        methods: which methods.
        strategies: how Gaussians are added and removed.
        presets: the recipes that this project found best, or those of the papers.
        seeds: one run for each.
        iterations: length of each run.
        downscale: shrink the photographs by this factor.
        mask_polarity: which value of black-and-white masks is the pane.
    """

    data: tuple[Path, ...]
    output: Path
    methods: tuple[Method, ...] = ("splat", "planar")
    strategies: tuple[Strategy, ...] = ("default",)
    presets: tuple[Preset, ...] = ("glassplat",)
    seeds: tuple[Seed, ...] = (0,)
    iterations: Several = 7000
    downscale: Downscale = 1.0
    mask_polarity: Polarity = "auto"

    def planned(self) -> list[PlannedRun]:
        """The runs that are asked for.

        Raises:
            InputError: options that contradict, or an output that no run can be written to.
        """
        recipes = {
            variant_name(method, strategy, preset): with_strategy(recipe_of(method, preset), strategy)
            for preset in unique(self.presets, "presets")
            for strategy in unique(self.strategies, "strategies")
            for method in unique(self.methods, "methods")
        }
        return planned_runs(self, recipes)

    def run(self, console: Console) -> None:
        """Runs what is missing and writes `scenes.md` and `scenes.json`, of earlier commands' runs in it too."""
        from glassplat.commands.measuring.bench_execution import execute

        runs, variants = self.planned(), all_variants()
        earlier = earlier_runs(self.output, variants, runs)
        execute(runs, console, lambda done: write_scenes(self.output, in_order([*done, *earlier], variants)))
        say(console, f"tables: {self.output / 'scenes.md'}, {self.output / 'scenes.json'}")


@dataclass(frozen=True)
class BenchAblation:
    """Train a method with each of its parts switched off and write the differences to the full method.

    Attributes:
        data: directories of the captures.
        output: where the tables and one directory per run go.
        method: which method.
        switches: which of its parts, one at a time; all of them if none is named.
        seeds: one run for each.
        iterations: length of each run.
        downscale: shrink the photographs by this factor.
        mask_polarity: which value of black-and-white masks is the pane.
    """

    data: tuple[Path, ...]
    output: Path
    method: Ablated = "planar"
    switches: tuple[Switch, ...] = ()
    seeds: tuple[Seed, ...] = (0,)
    iterations: Several = 7000
    downscale: Downscale = 1.0
    mask_polarity: Polarity = "auto"

    def planned(self) -> list[PlannedRun]:
        """The runs that are asked for.

        Raises:
            InputError: options that contradict, or an output that no run can be written to.
        """
        return planned_runs(self, ablation_recipes(RECIPES[self.method](), self.chosen()))

    def run(self, console: Console) -> None:
        """Runs what is missing and writes `ablation.md` and `ablation.json`, of earlier commands' runs in it too."""
        from glassplat.commands.measuring.bench_execution import execute

        full, ablations, known = RECIPES[self.method](), self.chosen(), ABLATIONS[self.method]
        runs = self.planned()
        variants = ablation_recipes(full, known)
        earlier = earlier_runs(self.output, variants, runs)
        kept = {run.run.variant for run in earlier}
        tabled = {s: part for s, part in known.items() if s in ablations or off_name(s) in kept}
        execute(runs, console, lambda done: write_ablation(self.output, tabled, in_order([*done, *earlier], variants)))
        say(console, f"tables: {self.output / 'ablation.md'}, {self.output / 'ablation.json'}")

    def chosen(self) -> dict[Switch, Ablation]:
        """The parts to switch off.

        Raises:
            InputError: one is not a part of the method, or is named twice.
        """
        known = ABLATIONS[self.method]
        foreign = [switch for switch in self.switches if switch not in known]
        if foreign:
            raise InputError(f"{self.method} has no parts {foreign}; expected --switches out of {list(known)}")
        return {switch: known[switch] for switch in unique(self.switches or tuple(known), "switches")}


AnyBench = (
    Annotated[BenchScenes, tyro.conf.subcommand("scenes")]
    | Annotated[BenchAblation, tyro.conf.subcommand("ablation")]
    | Annotated[BenchSeconds, tyro.conf.subcommand("seconds")]
)


@dataclass(frozen=True)
class Bench:
    """Compare methods over scenes or in a given time, or the parts of a method with each other.

    Attributes:
        comparison: what to compare.
    """

    comparison: Annotated[AnyBench, tyro.conf.arg(name="")]

    def ready(self) -> None:
        """Refuses what stands in the way, says what the captures' folders hold, and imports what trains."""
        say_captures(self.comparison.planned(), message_console())
        import_now("glassplat.commands.measuring.bench_execution")

    def run(self, console: Console) -> None:
        """Runs the comparison."""
        self.comparison.run(console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"finished runs stay in {self.comparison.output}: repeat the command to go on"


def variant_name(method: str, strategy: str, preset: Preset = "glassplat") -> str:
    """What tables and directories call a method with a strategy and a preset."""
    name = method if strategy == "default" else f"{method}-{strategy}"
    return name if preset == "glassplat" else f"{name}-{preset}"


def all_variants() -> dict[str, Any]:
    """The recipe of every variant that a table of scenes may hold."""
    return {
        variant_name(method, strategy, preset): with_strategy(recipe_of(method, preset), strategy)
        for preset in get_args(Preset)
        for strategy in get_args(Strategy)
        for method in get_args(Method)
    }


def compared_variants() -> list[tuple[str, str]]:
    """Which variants tables of scenes set against each other: methods and `splat`, and recipes and their papers'."""
    strategies, presets = get_args(Strategy), get_args(Preset)
    gains = [
        (variant_name(method, strategy, preset), variant_name("splat", strategy, preset))
        for preset in presets
        for strategy in strategies
        for method in ("planar", "deferred", "traced")
    ]
    changes = [
        (variant_name(method, strategy), variant_name(method, strategy, "paper"))
        for strategy in strategies
        for method in get_args(Method)
    ]
    return gains + changes


def off_name(switch: Switch) -> str:
    """What tables and directories call a method without one of its parts."""
    return f"no-{switch}"


def ablation_recipes(full: Any, ablations: Mapping[Switch, Ablation]) -> dict[str, Any]:
    """The full recipe, and those without one of its parts, by variant."""
    return {FULL: full} | {off_name(switch): ablation.off(full) for switch, ablation in ablations.items()}


def in_order(finished: Sequence[FinishedRun], variants: Iterable[str]) -> list[FinishedRun]:
    """The runs by scene, in the order in which scenes come, by seed, and as the variants are listed."""
    scenes, names = list(dict.fromkeys(f.run.scene for f in finished)), list(variants)
    return sorted(finished, key=lambda f: (scenes.index(f.run.scene), f.run.train.seed, names.index(f.run.variant)))


def with_strategy(recipe: Any, strategy: str) -> Any:
    """The recipe with a densification strategy.

    Raises:
        InputError: the recipe knows no strategies and another one than the default is asked for.
    """
    if any(field.name == "strategy" for field in dataclasses.fields(recipe)):
        return dataclasses.replace(recipe, strategy=strategy)
    if strategy != "default":
        raise InputError(
            f"{recipe.method} has no strategy {strategy!r} in this version of glassplat; expected --strategies default"
        )
    return recipe


def unique(choices: Sequence[Any], option: str) -> list[Any]:
    """The choices of an option, in order.

    Raises:
        InputError: one is named twice, or none is.
    """
    if len(set(choices)) < len(choices) or not choices:
        raise InputError(f"--{option} is {list(choices)}; expected at least one, and each once")
    return list(choices)


def planned_runs(bench: BenchScenes | BenchAblation, recipes: dict[str, Any]) -> list[PlannedRun]:
    """A run per capture, variant and seed; the paths are absolute, so that a bench goes on from any folder."""
    check_folder(bench.output)
    check_targets(bench.output, [bench.output / RUNS, *(bench.output / name for name in TABLES)], [])
    captures = zip(scene_names(bench.data), bench.data, strict=True)
    seeds = unique(bench.seeds, "seeds")
    return [
        PlannedRun(
            scene,
            variant,
            Train(
                recipe,
                real_path(data),
                bench.output / RUNS / scene / f"{variant}-seed{seed}",
                iterations=bench.iterations,
                downscale=bench.downscale,
                seed=seed,
                mask_polarity=bench.mask_polarity,
            ),
        )
        for scene, data in captures
        for seed in seeds
        for variant, recipe in recipes.items()
    ]


def write_scenes(output: Path, finished: Sequence[FinishedRun]) -> None:
    """Writes what is finished."""
    pairs = [Pair(f"{first} - {second}", first, second) for first, second in compared_variants()]
    measured = measured_runs(finished)
    reached, compared = means(measured), differences(measured, pairs)
    tables = [means_table(reached, "Scenes", " ".join([SPREAD_NOTE, *remarks(finished)]))]
    if compared:
        tables.append(differences_table(compared, "Differences", COMPARED_NOTE))
    write_text(output / "scenes.md", "\n".join(table.markdown() for table in tables))
    write_json(output / "scenes.json", finished, reached, compared)


def write_ablation(output: Path, ablations: Mapping[Switch, Ablation], finished: Sequence[FinishedRun]) -> None:
    """Writes what is finished."""
    measured = measured_runs(finished)
    pairs = [Pair(ablation.title, off_name(switch), FULL) for switch, ablation in ablations.items()]
    reached, compared = means(measured), differences(measured, pairs)
    published = [ablation for ablation in ablations.values() if ablation.paper_psnr is not None]
    paper = "; ".join(f"{ablation.title} {ablation.paper_psnr:+.2f}" for ablation in published)
    note = f"Each part left out, minus the full method. {COMPARED_NOTE}"
    if paper:
        note += f" The paper's psnr, on its own scenes: {paper}."
    tables = [
        differences_table(compared, "Ablation", note),
        means_table(reached, "Absolute values", " ".join([SPREAD_NOTE, *remarks(finished)])),
    ]
    write_text(output / "ablation.md", "\n".join(table.markdown() for table in tables))
    write_json(output / "ablation.json", finished, reached, compared)


def measured_runs(finished: Sequence[FinishedRun]) -> list[Measured]:
    """The columns of finished runs."""
    return [Measured(f.run.scene, f.run.variant, f.run.train.seed, values_of(f.results)) for f in finished]


def remarks(finished: Sequence[FinishedRun]) -> list[str]:
    """What the reader of a table must know: where the pane was, and which planes the errors leave out."""
    regions = dict.fromkeys(f.results["pane_region"] for f in finished if f.results.get("pane_region"))
    found = [f"The pane: {', '.join(regions)}."] if regions else []
    found += [
        f"{f.run.title}: panes {f.results['missing_panes']} were not found and count in no plane error."
        for f in finished
        if f.results.get("missing_panes")
    ]
    return found


def write_json(output: Path, finished: Sequence[FinishedRun], reached: list[Row], compared: list[Row]) -> None:
    """Writes every run's results and the rows of the tables."""
    runs = [
        {"scene": f.run.scene, "variant": f.run.variant, "directory": str(f.run.train.output), **f.results}
        for f in finished
    ]
    contents = {"runs": runs, "means": plain_rows(reached), "differences": plain_rows(compared)}
    write_text(output, json.dumps(contents, indent=2))
