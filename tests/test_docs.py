"""The documents are correct: links resolve, and the commands they show exist."""

from __future__ import annotations

import dataclasses
import re
import shlex
from pathlib import Path

import pytest
import torch

import glassplat
from glassplat.cli import main
from tests.training.tiny_capture import tiny_capture

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = sorted(
    [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("lab/*.md"), ROOT / "glassplat/demo_scene/README.md"]
)
MOST_README_LINES = 60

REPOSITORY = re.compile(
    r"https://(?:github\.com/glassplat/glassplat/blob|raw\.githubusercontent\.com/glassplat/glassplat)/main/"
)
"""The prefix that PyPI needs in links of the README, which it displays elsewhere."""
LINK = re.compile(r"\]\(([^)#\s]+)[^)]*\)")
SHELL_BLOCK = re.compile(r"```sh\n(.*?)```", re.DOTALL)


def shell_lines(page: Path) -> list[str]:
    """Commands in the shell blocks of a page, continued lines joined, comments removed."""
    blocks = SHELL_BLOCK.findall(page.read_text())
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.split(" #")[0].strip() for line in lines if line.strip()]


def commands(program: str) -> list[list[str]]:
    """The arguments of every different call of a program shown in the pages."""
    words = [shlex.split(line) for line in dict.fromkeys(line for page in PAGES for line in shell_lines(page))]
    return [line[line.index(program) + 1 :] for line in words if program in line]


def test_the_readme_fits_on_one_screen() -> None:
    assert len(README.read_text().splitlines()) <= MOST_README_LINES


def test_links_point_to_existing_files() -> None:
    for page in PAGES:
        targets = LINK.findall(page.read_text())
        absolute = [REPOSITORY.sub("", target) for target in targets if REPOSITORY.match(target)]
        relative = [target for target in targets if "://" not in target]
        missing = [target for target in absolute if not (ROOT / target).exists()]
        missing += [target for target in relative if not (page.parent / target).exists()]
        assert not missing, f"{page.relative_to(ROOT)} links to {missing}, which do not exist"


def test_the_readme_can_be_read_elsewhere() -> None:
    assert not [target for target in LINK.findall(README.read_text()) if "://" not in target]


def test_the_readme_shows_how_to_start() -> None:
    shown = [shlex.split(line)[1] for line in shell_lines(README) if line.startswith("glassplat")]
    assert {"train", "eval", "view"} <= set(shown)
    made = [shlex.split(line, comments=True)[1] for line in shell_lines(README) if line.startswith("make")]
    assert made == ["demo", "test"]


@pytest.mark.parametrize("arguments", commands("glassplat"), ids=" ".join)
def test_the_command_line_takes_every_command_shown(arguments: list[str]) -> None:
    assert type(main.parse_arguments(arguments)).__name__.startswith(main.COMMANDS[arguments[0]].kind)


def test_make_has_every_target_shown() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {word for arguments in commands("make") for word in arguments} <= targets


PYTHON_BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


def test_the_loss_term_of_a_custom_recipe_skips_stages_without_depths() -> None:
    blocks = PYTHON_BLOCK.findall((ROOT / "docs" / "python.md").read_text(encoding="utf-8"))
    (block,) = [block for block in blocks if "LossTerm" in block]
    names = {"glassplat": glassplat, "dataclasses": dataclasses}
    exec(block, names)
    stages = names["Calm"]().stages(seed=0)
    terms = [term for stage in stages for term in stage.losses if term.name == "calm"]
    assert len(terms) == len(stages)
    image, depth = torch.zeros(2, 3, 3), torch.tensor([[0.0, 1.0, 3.0], [0.0, 0.0, 0.0]])
    assert terms[0].function(glassplat.Frame(image, {}), None, None) is None
    assert terms[0].function(glassplat.Frame(image, {"depth": depth}), None, None) == 0.75


@pytest.mark.parametrize(
    ("recipe", "layer"), [("SplatRecipe", "depth"), ("DeferredRecipe", "depth"), ("SplatRecipe", "normal")]
)
def test_the_loss_term_of_a_custom_recipe_counts_in_every_step(recipe: str, layer: str) -> None:
    blocks = PYTHON_BLOCK.findall((ROOT / "docs" / "python.md").read_text(encoding="utf-8"))
    (block,) = [block for block in blocks if "LossTerm" in block]
    names = {"glassplat": glassplat, "dataclasses": dataclasses}
    exec(block.replace("PlanarRecipe", recipe).replace("depth", layer), names)
    messages = glassplat.Training(tiny_capture(), names["Calm"](), iterations=4)
    steps = [message for message in messages if isinstance(message, glassplat.StepDone)]
    assert len(steps) == 4 and all("calm" in step.losses for step in steps)


def test_data_in_memory_are_trained_on() -> None:
    blocks = PYTHON_BLOCK.findall((ROOT / "docs" / "python.md").read_text(encoding="utf-8"))
    (block,) = [block for block in blocks if "in_memory" in block]
    tiny = tiny_capture()
    shots = [(view.camera, view.photo) for view in tiny.train]
    names = {"glassplat": glassplat, "Path": Path, "shots": shots, **vars(tiny.points)}
    exec(block, names)
    model = glassplat.Training(names["own"], "splat", iterations=2).run()
    again = model.with_parameters(model.scene.tensors())
    assert len(model.cameras) == 6 and torch.equal(again.image("0.png"), model.image("0.png"))


MODULE = re.compile(r"python -m ((?:tools|benchmarks)(?:\.\w+)?)([^`\n|;]*)")


def module_calls() -> list[tuple[str, str]]:
    """Modules of this repository that the pages run, with the options shown; continued lines are joined."""
    text = "\n".join(page.read_text(encoding="utf-8").replace("\\\n", " ") for page in PAGES)
    return sorted({(module, option) for module, rest in MODULE.findall(text) for option in options_of(rest)})


def options_of(arguments: str) -> list[str]:
    """The options of a call outside quoted texts; one empty string if there are none."""
    bare = re.sub(r"\"[^\"]*\"|\s#.*", "", arguments)
    return re.findall(r"(?<=\s)--[a-z][a-z-]*", bare) or [""]


def test_tools_and_benchmarks_take_every_option_shown() -> None:
    for module, option in module_calls():
        path = ROOT / module.replace(".", "/")
        path = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
        source = path.read_text(encoding="utf-8")
        assert option in source or option.removeprefix("--").replace("-", "_") in source, (module, option)


def test_every_command_of_the_repository_explains_itself() -> None:
    sources = {
        path: path.read_text(encoding="utf-8") for name in ("tools", "benchmarks") for path in ROOT.glob(f"{name}/*.py")
    }
    commands = [path.name for path, source in sources.items() if '__name__ == "__main__"' in source]
    silent = [path.name for path, source in sources.items() if not re.search(r"\.parse_args\(|tyro\.cli\(", source)]
    assert len(commands) > 20 and not set(commands) & set(silent)


LAB_BOOK = ROOT / "lab"
MOST_LAB_BOOK_LINES = 800


def lab_rows() -> list[list[str]]:
    """The cells of every row of the lab book's tables: question, answer, numbers, commit."""
    pages = [page.read_text() for page in LAB_BOOK.glob("*.md") if page.name != "README.md"]
    lines = [line for page in pages for line in page.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_question_of_the_lab_book_has_an_answer_and_a_commit() -> None:
    unanswered = [row[0] for row in lab_rows() if len(row) != 4 or not (row[0] and row[1] and row[3])]
    assert not unanswered


def test_the_lab_book_stays_short_and_lists_its_pages() -> None:
    pages = sorted(page.name for page in LAB_BOOK.glob("*.md") if page.name != "README.md")
    assert sorted(set(LINK.findall((LAB_BOOK / "README.md").read_text()))) == pages
    assert sum(len(page.read_text().splitlines()) for page in LAB_BOOK.glob("*.md")) <= MOST_LAB_BOOK_LINES
