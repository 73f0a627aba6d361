"""The options of the command line: values out of range end in one line, and help shows the most common options."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest

from glassplat.cli import main as cli
from glassplat.cli.main import main
from glassplat.cli.train import SCENE
from glassplat.errors import InputError
from glassplat.methods.glossy_recipes import DeferredRecipe
from glassplat.methods.planar_recipe import Perturbation, PlanarRecipe
from glassplat.methods.recipe import RECIPES
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.options import check_options
from glassplat.panes import PlaneFit
from glassplat.training.options import GaussianRates, McmcDensify, NormalPropagation

LARGE = str(10**30)
WRONG = [
    ["splat", "--sh-degree", "7"],
    ["splat", "--sh-degree", "4"],
    ["splat", "--sh-degree", "-1"],
    ["planar", "--rates.means", "-1"],
    ["planar", "--rates.means", "nan"],
    ["planar", "--rates.means", "inf"],
    ["splat", "--seed", LARGE],
    ["splat", "--seed", "-1"],
    ["planar", "--glass-count", "-1"],
    ["planar", "--glass-count", "0"],
    ["planar", "--glass-count", "1000000000000"],
    ["planar", "--weights.depth", "-0.1"],
    ["planar", "--weights.mask", "inf"],
    ["planar", "--plane-fit.mirror-labels", "0"],
    ["planar", "--downscale", "1000"],
    ["splat", "--downscale", "1000"],
    ["splat", "--downscale", "0.5"],
    ["splat", "--downscale", "nan"],
    ["splat", "--background", "-1", "0", "0"],
    ["splat", "--background", "nan", "0", "0"],
    ["splat", "--iterations", "0"],
    ["splat", "--iterations", LARGE],
    ["splat", "--densify.cap", "-5"],
    ["splat", "--cap", LARGE],
    ["splat", "--densify.stop", "1.5"],
    ["splat", "--intervals.averaged-passes", "-1"],
    ["deferred", "--texels", "0"],
    ["deferred", "--texels", LARGE],
    ["deferred", "--region", "0", "0", "0", "-1"],
    ["deferred", "--region", "0", "0", "0", "1e13"],
    ["deferred", "--schedule.stop", "0.01"],
]


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The error message that ends a command line."""
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert "Traceback" not in said.out + said.err
    return " ".join(said.err.split())


def test_a_limit_of_another_strategy_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    begun = ["train", "planar", "--data", str(SCENE), "--output", str(tmp_path / "run"), "--cap", "10"]
    assert "--densify.cap" in refused(begun, capsys)


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_an_invalid_option_ends_with_one_message(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    method, option, *_ = arguments
    output = tmp_path / "run"
    message = refused(["train", method, "--data", str(SCENE), "--output", str(output), *arguments[1:]], capsys)
    named = {"--cap": "--mcmc.cap", "--downscale": "downscale"}.get(option, option)
    assert message.startswith("error: ") and named in message and "expected" in message
    assert not output.exists()


@pytest.mark.parametrize(
    ("recipe", "named"),
    [
        (PlanarRecipe(rates=GaussianRates(decay=0.0)), "--rates.decay"),
        (PlanarRecipe(plane_fit=PlaneFit(seed=10**30)), "--plane-fit.seed"),
        (PlanarRecipe(stage_shares=(0.0, 0.0, 0.0)), "--stage-shares"),
        (PlanarRecipe(stage_shares=(math.nan, 1.0, 1.0)), "--stage-shares"),
        (PlanarRecipe(stage_shares=(1.0, -1.0, 1.0)), "--stage-shares"),
        (PlanarRecipe(perturbation=Perturbation(bounds=(0.9, 0.1))), "--perturbation.bounds"),
        (SplatRecipe(mcmc=McmcDensify(growth=0.5)), "--mcmc.growth"),
        (DeferredRecipe(propagation=NormalPropagation(least_opacity=1.0)), "--propagation.least-opacity"),
    ],
    ids=str,
)
def test_fields_set_only_in_python_are_checked(recipe: Any, named: str) -> None:
    with pytest.raises(InputError, match=f"{named} is .*expected"):
        check_options(recipe)


@pytest.mark.parametrize(
    "arguments",
    [
        ["demo", "--iterations", "0"],
        ["demo", "--seed", "-1"],
        ["render", "run", "--output", "y", "--shift", "1", "nan"],
        ["render", "run", "--output", "y", "--tilt", "1", "inf", "0"],
        ["export", "run", "--output", "y", "--shift", "1", "1e13"],
        ["export", "run", "--output", "y", "--tilt", "1", "1e300", "0"],
        ["render", "run", "--output", "y", "--reflectance", "1", "2"],
    ],
    ids=" ".join,
)
def test_options_of_other_commands_out_of_range_are_refused(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (option,) = [word for word in arguments if word.startswith("--")][-1:]
    message = refused(arguments, capsys)
    assert option in message and "expected" in message


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["train", "splat", "--data", "", "--output", "x"], "--data"),
        (["train", "splat", "--data=", "--output", "x"], "--data"),
        (["train", "splat", "--data", "x", "--output", ""], "--output"),
        (["eval", ""], "eval"),
    ],
    ids=str,
)
def test_an_empty_argument_is_not_the_current_folder(
    arguments: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refused(arguments, capsys)
    assert named in message and "empty" in message


def help_of(arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stopped:
        main(["train", *arguments])
    assert stopped.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("method", RECIPES)
def test_help_shows_essential_options_and_names_the_option_for_the_rest(
    method: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    brief = help_of([method, "--help"], capsys, monkeypatch)
    assert len(brief.splitlines()) <= 80 and "--help-advanced" in brief
    assert {"--data", "--output", "--iterations", "--preset", "--background", "--strategy", "--cap"} <= options(brief)
    full = help_of([method, "--help-advanced"], capsys, monkeypatch)
    assert options(brief) - {"--help-advanced"} < options(full)
    assert "--rates.means" in options(full) - options(brief)
    assert len(settings(brief)) <= 25 and len(settings(full)) <= 60


def test_help_names_the_option_for_all_options_once(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert help_of(["planar", "--help"], capsys, monkeypatch).count("These are the most common options") == 1
    listed = help_of(["--help"], capsys, monkeypatch)
    assert "These are the most common options" not in listed and "the most common ones" in " ".join(listed.split())


@pytest.mark.parametrize("method", list(RECIPES))
def test_help_mentions_options_and_no_internal_names(
    method: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = help_of([method, "--help-advanced"], capsys, monkeypatch) + help_of(["--help"], capsys, monkeypatch)
    assert not re.search("train_options|find_region|`plane_fit|`per_pixel|`raise_rates|lab/|of both", shown)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ("train traced --data x --output y --iteratons 5", ["--iterations? all options", "train traced --help-adv"]),
        ("train planar --data x --output y --iteration 5", ["did you mean --iterations?", "train planar --help-adv"]),
        ("train planar --data x --output y --means 5", ["did you mean --rates.means?"]),
        ("train planar --data x --output y --noise 5", ["did you mean --mcmc.noise-rate?"]),
        ("train splat --data x --output y --tint", ["--tint; it is an option of planar; all options"]),
        ("train planer --data x --output y", ["no method 'planer'; did you mean planar?", "glassplat train --help"]),
        ("train planar more --data x --output y", ["glassplat train takes no further argument 'more'"]),
        ("tarin planar --data x --output y", ["no command 'tarin'; did you mean train?"]),
        ("--versoin", ["no command '--versoin'; expected one of prepare", "see glassplat --help"]),
        ("", ["a command is missing; expected one of prepare"]),
        ("evaluate x", ["no command 'evaluate'; did you mean eval?"]),
        ("tidy x", ["no command 'tidy'; expected one of prepare, annotate, train"]),
        ("render x --output y --lyers z", ["glassplat render has no option --lyers; did you mean --layers?"]),
        ("train planar --data x --output y --iterations abc", ["--iterations: expected a whole number, not 'abc';"]),
        ("train planar --data x --output y --memory=a --view", ["--memory: expected None or a number, not 'a';"]),
        ("train splat --data x --output y --background 0 a", ["--background: expected None or 3 numbers, not '0 a'"]),
        ("train splat --data x --output y --rates.means ''", ["--rates.means: expected a number, not"]),
    ],
)
@pytest.mark.parametrize("width", ["50", "200"])
def test_a_mistyped_word_is_answered_with_what_exists(
    arguments: str, parts: list[str], width: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", width)
    message = refused(arguments.split(), capsys)
    assert message.startswith("error: ") and all(part in message for part in parts)


def test_the_help_of_the_method_is_named_next_to_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    for method in ("planar", "traced"):
        assert refused(["train", method, "--data", "x"], capsys).endswith(f"glassplat train {method} --help-advanced")


@pytest.mark.parametrize(
    "option", [["--intervals.opacity", "0.1"], ["--densify.split-by", "absgrad"], ["--blend", "srgb"]]
)
def test_fields_set_by_a_preset_are_no_options(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    message = refused(["train", "planar", "--data", str(SCENE), "--output", "y", *option], capsys)
    assert f"no option {option[0]}" in message


def settings(text: str) -> set[str]:
    """The options of a help text, counting each switch once."""
    return {name for name in options(text) if "no-" not in name and not name.startswith("--help")}


def options(text: str) -> set[str]:
    """Options listed in a help text; descriptions may mention others, in backquotes."""
    return set(re.findall(r"(?<![\w`-])--[a-z0-9.-]+", text))


def test_help_shows_the_defaults_of_the_preset(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = [
        " ".join(help_of(["planar", "--help-advanced", *preset], capsys, monkeypatch).replace("│", " ").split())
        for preset in ([], ["--preset", "paper"])
    ]
    assert all("--view-dependence-weight FLOAT" in text for text in shown)
    assert ["the paper has no such term. (default: 0.0)" in text for text in shown] == [False, True]


def test_the_recipe_of_a_preset_is_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    arguments = ["--data", str(SCENE), "--output", str(run), "--downscale", "12", "--iterations", "3"]
    assert main(["train", "splat", "--preset", "paper", *arguments]) == 0
    recorded = (run / "recipe.json").read_text()
    assert '"split_by": "gradient"' in recorded and '"short_run_power": 0.0' in recorded
    assert main(["train", "splat", *arguments, "--resume"]) == 2
    assert main(["train", "splat", "--preset", "paper", *arguments, "--resume"]) == 0
    capsys.readouterr()
    assert main(["train", "planar", *arguments, f"--config={run / 'recipe.json'}"]) == 2
    assert "recipe.json is a recipe of splat; expected one of planar" in " ".join(capsys.readouterr().err.split())


def test_every_method_is_offered(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = []
    monkeypatch.setattr(cli, "run", taken.append)
    for method, kind in RECIPES.items():
        assert main(["train", method, "--data", str(SCENE), "--output", "y"]) == 0
        assert type(taken[-1].recipe) is kind
