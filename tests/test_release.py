"""What must agree before a release: versions, the Dockerfile and the package."""

import re
from pathlib import Path

import pytest
import yaml
from test_architecture import PYPROJECT
from test_documents import module_of

ROOT = Path(__file__).parents[1]


def test_version__is_the_same_everywhere() -> None:
    version = PYPROJECT["project"]["version"]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    assert re.findall(r"version = \{(.*?)\}", (ROOT / "README.md").read_text()) == [version]


@pytest.mark.parametrize("address", [None, "https://example.org/owner/name"])
def test_pypi_readme__has_no_relative_links(address: str | None) -> None:
    text = module_of("pypi_readme").whole((ROOT / "README.md").read_text(), address, "9.8.7")
    links = re.findall(r"\]\(([^)]*)\)", text)
    assert all(re.match(r"https://|#", link) for link in links)
    paths = [link.removeprefix(f"{address}/") for link in links if address and link.startswith(address)]
    assert all((ROOT / re.sub(r"^(blob|raw)/v9.8.7/|#.*", "", path)).is_file() for path in paths)
    assert bool(paths) is bool(address)


def test_dockerfile__copies_the_package_and_installs_extras_that_exist() -> None:
    text = (ROOT / "Dockerfile").read_text()
    copied = {word for line in re.findall(r"^COPY (.*) \S+$", text, re.MULTILINE) for word in line.split()}
    assert copied == {"pyproject.toml", "README.md", "LICENSE", "cli", "configs", "sat_intervals"}
    assert {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")} == copied
    (extras,) = re.findall(r"pip install .*'\.\[(.*?)\]'", text)
    assert set(extras.split(",")) <= PYPROJECT["project"]["optional-dependencies"].keys()
    assert re.findall(r"^USER (\w+)$", text, re.MULTILINE) == ["user"]
