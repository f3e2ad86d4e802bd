"""The documents: README stays short, links lead somewhere, and code cites sections that exist."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "METHOD.md", *sorted((ROOT / "docs").glob("*.md"))]
MOST_WORDS, MOST_WORDS_OF_A_SENTENCE = 1800, 30


def prose(text: str) -> str:
    """Return a document without code blocks, tables, pictures and the targets of links."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^(\||!\[).*$", "", text, flags=re.MULTILINE)
    return re.sub(r"\]\([^)]*\)", "]", text)


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of all paragraphs, list items and headings."""
    for block in re.split(r"\n\s*\n|\n(?=[#-])", prose(text)):
        yield from re.split(r"(?<=[.!?])[*_]*\s+", block)


def anchors(document: Path) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a document."""
    headings = re.findall(r"^#+ (.*)$", document.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def sections(text: str) -> Iterator[int]:
    """Yield the numbers of the sections of METHOD.md that a text cites."""
    text = re.sub(r"\s+#?\s*", " ", text)
    for one in re.finditer(r"METHOD\.md, sections? (\d+(?:(?:, | and | to )\d+)*)", text):
        yield from map(int, re.findall(r"\d+", one[1]))


def test_readme__is_short() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.split()) <= MOST_WORDS
    long = [" ".join(one.split()) for one in sentences(text) if len(one.split()) > MOST_WORDS_OF_A_SENTENCE]
    assert long == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda file: file.name)
def test_links__lead_to_files_and_headings(document: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = document.parent / name if name else document
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_code__cites_sections_that_exist() -> None:
    numbers = {int(n) for n in re.findall(r"^## (\d+)\. ", (ROOT / "METHOD.md").read_text(), re.MULTILINE)}
    folders = ("sat_intervals", "cli", "configs", "tests", "docs")
    files = [
        file for folder in folders for ending in ("py", "yaml", "md") for file in (ROOT / folder).rglob(f"*.{ending}")
    ]
    cited = {(file.name, number) for file in files for number in sections(file.read_text())}
    assert len(cited) > 10
    assert {one for one in cited if one[1] not in numbers} == set()
    old = [file.name for file in files if file != Path(__file__) and re.search(r"method: section", file.read_text())]
    assert old == []
