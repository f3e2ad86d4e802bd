"""Compare tags of files with the run or the image that they were made from."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sat_intervals.raster.layers import read_tags

# Tag of what belongs to a left image.
_LEFT = "LEFT_SHA256"

_LOG = logging.getLogger(__name__)


def is_surface_of(surface: Path, run: str) -> bool:
    """Return whether a surface model has points of a run, by the time when it finished."""
    return run in read_tags(surface).get("RUNS", "").split()


def tag_of_left(left: Mapping[str, Any]) -> dict[str, str]:
    """Return the tag by which `tags_beside` recognises the left image of an `identity`; empty without its SHA-256."""
    return {_LEFT: left["sha256"]} if "sha256" in left else {}


def tags_beside(path: str | Path, left: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags of a raster; warn if it was made for another image than that of the `identity` ``left``."""
    tags = read_tags(path)
    if (made_for := tags.get(_LEFT)) and made_for != left.get("sha256", made_for):
        _LOG.warning("%s was made for another left image than %s: check that it is of this pair", path, left["path"])
    return tags
