"""Measure the prose of the documentation, and reject text that is hard to read.

    python -m tools.check_prose

It checks README.md, CONTRIBUTING.md, SECURITY.md and the pages in docs/: their length, the mean and the longest
sentence, and words that are private to this project or obscure. In Python files no docstring may begin with a question
word such as "Whether ..." or "What ...".
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
CODE_FOLDERS = ("glassplat", "tools", "benchmarks", "examples")

MOST_DOCS_LINES = 2300
MOST_DOCS_WORDS = 30_000
MOST_README_LINES = 60
MOST_MEAN_WORDS = 20
MOST_SENTENCE_WORDS = 40

BANNED = {
    r"beats?\b": "interval",
    r"rhythm": "schedule",
    r"hurry": "learn faster",
    r"heeds?\b": "respects",
    r"whom\b": "who",
    r"beside\b": "next to, compared with",
    r"to and fro": "back and forth",
    r"likewise": "too",
    r"therein|thereby|wherein|whereby": "a plainer word",
    r"all the same\b": "anyway",
    r"what can be said of": "say it",
    r"is (?:nobody's|the) business of": "is for",
    r"throws? back": "reflects",
    r"shares? out": "splits",
}
"""Patterns of words to avoid on pages, and their replacements. Code is not checked."""

RIDDLE = re.compile(r"(Whether|What|How|Which|Who|Whom|Whose|Why|When|Where)\b")

FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
PICTURE = re.compile(r"!\[[^\]]*\]\([^)]*\)")
LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
CODE = re.compile(r"`[^`]*`")
SENTENCE_END = re.compile(r"(?<=[.!?])[\"')*]*\s+(?=[A-Z0-9`*\"(~-])")


@dataclass(frozen=True)
class Prose:
    """The sentences of a page.

    Attributes:
        sentences: sentences of paragraphs and lists.
        cells: sentences in cells of tables, which count for the longest sentence and not for the mean.
    """

    sentences: list[str]
    cells: list[str]


def prose_of(markdown: str) -> Prose:
    """Split a page into sentences; code, images, comments and headings are left out."""
    text = PICTURE.sub("", COMMENT.sub("", FENCE.sub("\n", markdown)))
    text = LINK.sub(r"\1", CODE.sub("Code", text))
    blocks: list[str] = []
    cells: list[str] = []
    for line in text.splitlines():
        bare = line.strip()
        if bare.startswith("|"):
            cells += [part for cell in bare.strip("|").split("|") for part in SENTENCE_END.split(cell.strip())]
            blocks.append("")
        elif line.startswith("    ") and not (blocks and blocks[-1]):
            continue
        elif not bare or bare.startswith(("#", "!!!", "---")):
            blocks.append("")
        elif re.match(r"([-*]|\d+\.) ", bare) or not blocks:
            blocks.append(re.sub(r"^([-*]|\d+\.) ", "", bare))
        else:
            blocks[-1] = f"{blocks[-1]} {bare}".strip()
    sentences = [sentence for block in blocks if block for sentence in SENTENCE_END.split(block)]
    return Prose([s for s in sentences if words_of(s)], [c for c in cells if words_of(c)])


def words_of(text: str) -> list[str]:
    """Words of a text: tokens that contain a letter or a digit."""
    return [word for word in text.split() if re.search(r"\w", word)]


def page_complaints(name: str, markdown: str) -> Iterator[str]:
    """Long sentences and banned words of one page."""
    prose = prose_of(markdown)
    for sentence in (*prose.sentences, *prose.cells):
        if len(words_of(sentence)) > MOST_SENTENCE_WORDS:
            yield f"{name}: {len(words_of(sentence))} words in one sentence: {sentence[:70]} ..."
        for pattern, better in BANNED.items():
            if found := re.search(rf"\b(?:{pattern})", sentence, re.IGNORECASE):
                yield f"{name}: {found.group()!r} (write: {better}): {sentence[:70]}"


def mean_words(prose: Prose) -> float:
    """Mean length of the sentences, in words."""
    return sum(len(words_of(s)) for s in prose.sentences) / max(1, len(prose.sentences))


def size_complaints(readme: str, pages: dict[str, str]) -> Iterator[str]:
    """Complaints if README or docs, or their sentences on average, are too long."""
    lines = sum(len(text.splitlines()) for text in pages.values())
    words = sum(len(text.split()) for text in pages.values())
    if lines > MOST_DOCS_LINES or words > MOST_DOCS_WORDS:
        yield f"docs/: {lines} lines and {words} words; at most {MOST_DOCS_LINES} and {MOST_DOCS_WORDS}"
    if len(readme.splitlines()) > MOST_README_LINES:
        yield f"README.md: {len(readme.splitlines())} lines; at most {MOST_README_LINES}"
    for name, text in pages.items():
        if (mean := mean_words(prose_of(text))) > MOST_MEAN_WORDS:
            yield f"{name}: {mean:.1f} words in the mean sentence; at most {MOST_MEAN_WORDS}"


def riddles(path: Path) -> Iterator[str]:
    """Docstrings of a file that begin with a question word instead of a noun or an imperative."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = (ast.get_docstring(node) or "").partition("\n")[0]
            if RIDDLE.match(first):
                line = 1 if isinstance(node, ast.Module) else node.lineno
                yield f"{path.relative_to(ROOT)}:{line}: a docstring begins with a riddle: {first[:70]}"


def main() -> None:
    """Print the measurements and all complaints; exit with 1 if there are any."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    paths = sorted((ROOT / "docs").glob("**/*.md"))
    pages = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in paths}
    complaints = list(size_complaints(readme, pages))
    others = {name: (ROOT / name).read_text(encoding="utf-8") for name in ("CONTRIBUTING.md", "SECURITY.md")}
    for name, text in {"README.md": readme, **others, **pages}.items():
        complaints += page_complaints(name, text)
    files = sorted(path for folder in CODE_FOLDERS for path in (ROOT / folder).rglob("*.py"))
    complaints += [complaint for path in files for complaint in riddles(path)]
    sentences = Prose([s for text in (readme, *pages.values()) for s in prose_of(text).sentences], [])
    lines, words = (sum(len(split(text)) for text in pages.values()) for split in (str.splitlines, str.split))
    print(f"docs/: {lines} lines, {words} words; README.md: {len(readme.splitlines())} lines")
    print(f"{mean_words(sentences):.1f} words in the mean sentence")
    if complaints:
        print("\n".join(complaints))
        sys.exit(1)


if __name__ == "__main__":
    main()
