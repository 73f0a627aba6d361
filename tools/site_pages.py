"""Hooks of MkDocs: the public names for the reference, and pages of the repository outside of docs/.

Pages in docs/ link to the latter as files of the repository (`../lab/panes.md`); in the site they are in one tree.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

import glassplat

ROOT = Path(__file__).parent.parent
PAGES = ("CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md", "LICENSE", "CITATION.cff", "Dockerfile")
PATTERNS = ("lab/*.md", "examples/*.py", "examples/*.ipynb")

NAMES = "<!-- names -->"
UPWARDS = re.compile(r"\]\(\.\./")
INTO_DOCS = re.compile(r"\]\((\.\./)?docs/")


def on_files(files: Files, *, config: Any) -> Files:
    """Add the pages outside of docs/."""
    paths = [ROOT / name for name in PAGES]
    paths += [path for pattern in PATTERNS for path in sorted(ROOT.glob(pattern))]
    for path in paths:
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Redirect links to the locations of the pages in the site."""
    name = page.file.src_uri
    if name.startswith("lab/"):
        return INTO_DOCS.sub("](../", markdown)
    if name in PAGES:
        return INTO_DOCS.sub("](", markdown)
    return UPWARDS.sub("](", markdown).replace(NAMES, reference())


def reference() -> str:
    """An entry for every public name of the package, in the order of `__all__`."""
    homes = {name: module for module, names in glassplat.NAMES_BY_MODULE.items() for name in names}
    return "\n\n".join(f"::: glassplat.{homes[name]}.{name}" for name in glassplat.__all__)
