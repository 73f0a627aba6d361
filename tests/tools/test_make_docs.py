"""The documentation site: every public name with what it says of itself."""

from __future__ import annotations

import html
import re
from pathlib import Path

import pytest

import glassplat

pytest.importorskip("pdoc", reason="pdoc is not installed: pip install 'glassplat[docs]'")


def test_the_site_tells_of_every_public_name(tmp_path: Path) -> None:
    from tools.make_docs import make_docs

    pages = {page.name: page.read_text() for page in make_docs(tmp_path)}
    assert set(pages) == {"glassplat.html", "index.html"}
    page = pages["glassplat.html"]
    assert [name for name in glassplat.__all__ if f'id="{name}"' not in page] == []
    text = html.unescape(re.sub(r"<[^>]+>", "", page))
    assert "Opens a trained run, an imported scene, or a splat file of any program." in text
    assert "differentiable in every tensor of the scene" in text and "Arguments:" in text
    links = set(re.findall(r'href="#([\w.]+)"', page))
    assert [link for link in links if f'id="{link}"' not in page] == []


def test_the_site_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    from tools.make_docs import make_docs

    make_docs(tmp_path)
    loaded = re.findall(r'(?:src|href)="(https?://[^"]+)"', (tmp_path / "glassplat.html").read_text())
    assert [address for address in loaded if "pdoc.dev" not in address] == []
