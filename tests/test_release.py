"""What must agree before a release: versions, the Dockerfile and the package."""

import re
from pathlib import Path

import yaml
from test_architecture import PYPROJECT

ROOT = Path(__file__).parents[1]


def test_version__is_the_same_everywhere() -> None:
    version = PYPROJECT["project"]["version"]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    assert re.findall(r"version = \{(.*?)\}", (ROOT / "README.md").read_text()) == [version]


def test_dockerfile__copies_the_package_and_installs_extras_that_exist() -> None:
    text = (ROOT / "Dockerfile").read_text()
    copied = {word for line in re.findall(r"^COPY (.*) \S+$", text, re.MULTILINE) for word in line.split()}
    assert copied == {"pyproject.toml", "README.md", "LICENSE", "cli", "configs", "sat_intervals"}
    assert {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")} == copied
    (extras,) = re.findall(r"pip install .*'\.\[(.*?)\]'", text)
    assert set(extras.split(",")) <= PYPROJECT["project"]["optional-dependencies"].keys()
    assert re.findall(r"^USER (\w+)$", text, re.MULTILINE) == ["user"]
