"""The documentation of the Python interface as a site, from its docstrings.

python -m tools.make_docs build/docs
"""

from __future__ import annotations

import sys
from pathlib import Path

import pdoc
import pdoc.render

PUBLIC = ("glassplat", r"!glassplat\..+")
"""The names of the package itself; where they live is nobody's business."""


def make_docs(folder: Path) -> list[Path]:
    """Writes the site; returns its pages."""
    pdoc.render.configure(docformat="google", show_source=False, footer_text="glassplat", include_undocumented=False)
    pdoc.pdoc(*PUBLIC, output_directory=folder)
    return sorted(folder.glob("*.html"))


def main() -> None:
    """Says where it is."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/docs")
    make_docs(folder)
    print(folder / "glassplat.html")


if __name__ == "__main__":
    main()
