"""The documentation as a site: complete, without dead links, with every public name."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import glassplat

pytest.importorskip("mkdocs", reason="MkDocs is not installed: pip install 'glassplat[docs]'")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as built by `make docs`; warnings are errors there."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_the_site_has_every_page_and_every_public_name(site: Path) -> None:
    pages = {path.relative_to(ROOT / "docs") for path in (ROOT / "docs").glob("**/*.md")}
    pages |= {path.relative_to(ROOT) for path in (ROOT / "lab").glob("*.md") if path.name != "README.md"}
    assert [page for page in pages if not (site / page).with_suffix(".html").is_file()] == []
    reference = (site / "reference.html").read_text(encoding="utf-8")
    assert [name for name in glassplat.__all__ if not re.search(rf'id="glassplat\.[\w.]+\.{name}"', reference)] == []


def test_the_site_loads_nothing_from_elsewhere(site: Path) -> None:
    pattern = re.compile(r'<(?:link|script|img|iframe)[^>]+(?:src|href)="(https?://[^"]+)"')
    loaded = {address for page in site.glob("**/*.html") for address in pattern.findall(page.read_text("utf-8"))}
    assert not loaded
