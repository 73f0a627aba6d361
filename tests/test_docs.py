"""The documents keep their promises: links lead somewhere, and the commands they show exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from glassplat.cli import main

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "glassplat/demo_scene/README.md"])
MOST_README_LINES = 60

LINK = re.compile(r"\]\(([^)#\s]+)[^)]*\)")
SHELL_BLOCK = re.compile(r"```sh\n(.*?)```", re.DOTALL)


def shell_lines(page: Path) -> list[str]:
    """Commands in the shell blocks of a page, continued lines joined, comments removed."""
    blocks = SHELL_BLOCK.findall(page.read_text())
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.split(" #")[0].strip() for line in lines if line.strip()]


def commands(program: str) -> list[list[str]]:
    """The arguments of every call of a program that the pages show."""
    words = [shlex.split(line) for page in PAGES for line in shell_lines(page)]
    return [line[line.index(program) + 1 :] for line in words if program in line]


def test_the_readme_fits_on_one_screen() -> None:
    assert len(README.read_text().splitlines()) <= MOST_README_LINES


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_that_exist(page: Path) -> None:
    targets = [target for target in LINK.findall(page.read_text()) if "://" not in target]
    missing = [target for target in targets if not (page.parent / target).exists()]
    assert not missing, f"{page.relative_to(ROOT)} links to {missing}, which do not exist"


def test_the_readme_shows_how_to_start() -> None:
    assert {"train", "eval", "render"} <= {arguments[0] for arguments in commands("glassplat")}
    assert {"demo", "test"} <= {arguments[0] for arguments in commands("make")}


@pytest.mark.parametrize("arguments", commands("glassplat"), ids=" ".join)
def test_the_command_line_takes_every_command_shown(arguments: list[str]) -> None:
    assert type(main.parsed(arguments)).__name__.startswith(main.COMMANDS[arguments[0]].kind)


@pytest.mark.parametrize("arguments", commands("make"), ids=" ".join)
def test_make_has_every_target_shown(arguments: list[str]) -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(arguments) <= targets


LAB_BOOK = ROOT / "docs" / "experiments.md"


def anchor(heading: str) -> str:
    """The anchor that a Markdown page gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_the_lab_book_answers_every_question_in_its_index() -> None:
    indexed = re.findall(r"\| \[(.*?)\]\(experiments/(\w+\.md)#(\S+)\) \| \S", LAB_BOOK.read_text())
    entries = {
        (heading, page.name, anchor(heading))
        for page in (ROOT / "docs" / "experiments").glob("*.md")
        for heading in re.findall(r"^## (.*)$", page.read_text(), re.MULTILINE)
    }
    assert len(indexed) == len(set(indexed))
    assert set(indexed) == entries
