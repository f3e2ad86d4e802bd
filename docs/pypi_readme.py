"""Make links and pictures of a README whole addresses, since PyPI resolves no others; ``make dist`` runs it.

usage: python docs/pypi_readme.py FOLDER: README.md there is rewritten. The address is Repository in [project.urls] of
pyproject.toml, at the tag of the version; without one links become text, and pictures go.
"""

import re
import sys
import tomllib
from pathlib import Path

RELATIVE = re.compile(r"(!?)\[([^\]]*)\]\((?![a-z]+:|#)([^)\s]+)\)")


def whole(text: str, address: str | None, version: str) -> str:
    """Return a README without relative links."""

    def link(found: re.Match[str]) -> str:
        picture, words, path = found.groups()
        if not address:
            return "" if picture else words
        return f"{picture}[{words}]({address}/{'raw' if picture else 'blob'}/v{version}/{path})"

    return RELATIVE.sub(link, text)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    readme = folder / "README.md"
    readme.write_text(whole(readme.read_text(), project.get("urls", {}).get("Repository"), project["version"]))
