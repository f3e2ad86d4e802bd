"""Compare files of a run with what they were made from: points, surface models, truths and ranges."""

import json
import logging
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from sat_intervals.errors import InputError, SatIntervalsError, open_regular
from sat_intervals.raster.files import POINT_FILES
from sat_intervals.raster.identity import checksum_of, known_checksum
from sat_intervals.raster.layers import read_alone, read_tags
from sat_intervals.raster.old_publishing import POINTS_REPORT, RUN_REPORT
from sat_intervals.raster.seal import check_seal, seal_of

POINTS_FILE = POINT_FILES[0].name
# Tag of what belongs to a left image.
_LEFT = "LEFT_SHA256"

_LOG = logging.getLogger(__name__)


def check_points(out: Path) -> None:
    """Raise if the bytes of ``points.tif`` differ from those that were published, or from the CRC-32 in it.

    Without ``points.json``, there is only the latter. Earlier versions wrote neither.

    Raises
    ------
    SatIntervalsError
        Names the damaged file, or one beside it that GDAL reads too.
    """
    read_alone(out / POINTS_FILE)
    published = published_points(out)
    if published is None:
        check_seal(out / POINTS_FILE, [])
    elif published != checksum_of(out / POINTS_FILE):
        raise SatIntervalsError(
            f"{out / POINTS_FILE} is not what triangulate published; it is damaged or was changed: move it away and "
            "triangulate again"
        )


def published_points(out: Path) -> dict[str, int] | None:
    """Return size and CRC-32 of ``points.tif`` from ``points.json``; None if that is missing."""
    file = out / POINTS_REPORT
    try:
        with open_regular(file) as stream:
            report = json.loads(stream.read().decode())
        if report.keys() != {"files"}:  # it was edited
            raise LookupError(file)
        return known_checksum(report["files"][POINTS_FILE])
    except FileNotFoundError:
        return None
    except SatIntervalsError:
        raise
    except OSError as error:
        raise SatIntervalsError(f"{file} cannot be read: {error.strerror}: move it away") from error
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise SatIntervalsError(
            f"{file} is not the report of {POINTS_FILE}: move it away and triangulate again"
        ) from error


def is_points_of(points: Path, run: str) -> bool:
    """Return whether points are of a run, by the time when it finished; raises SatIntervalsError if unreadable."""
    return _tags(points).get("RUN") == run


def is_surface_of(surface: Path, run: str) -> bool:
    """Return whether a surface model is of a run and of the points beside it, if any; raises as `is_points_of`.

    Its other runs must still be the ones that it was made from, too, where they are in the same folders. Earlier
    versions noted neither points nor folders.
    """
    tags, beside = _tags(surface), surface.with_name(POINTS_FILE)
    runs, points = (tags.get(name, "").split() for name in ("RUNS", "POINTS"))
    if run not in runs or (points and beside.exists() and checksum_of_points(beside) not in points):
        return False
    folders = [surface.parent / name for name in json.loads(tags.get("FOLDERS", "[]"))]
    return all(map(_is_as_it_was, folders, runs, points))


def folders_of(surface: Path, outs: Iterable[Path]) -> str:
    """Return the folders of a surface's runs, relative to its own, for its tag ``FOLDERS``."""
    return json.dumps([os.path.relpath(out.resolve(), surface.parent.resolve()) for out in outs])


def _is_as_it_was(out: Path, run: str, points: str) -> bool:
    """Return whether a folder has the run that ended at this time and its points of this CRC-32, or lacks them."""
    report, file = out / RUN_REPORT, out / POINTS_FILE
    try:
        if file.exists() and checksum_of_points(file) != points:
            return False
        if not report.exists():
            return True
        with open_regular(report) as stream:
            return bool(json.loads(stream.read())["finished"] == run)
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return False


def checksum_of_points(points: Path) -> str:
    """Return the CRC-32 in a file, or that of a file without one: eight hexadecimal digits."""
    return seal_of(points) or f"{checksum_of(points)['crc32']:08x}"


def tag_of_left(left: Mapping[str, Any]) -> dict[str, str]:
    """Return the tag by which `tags_beside` recognises the left image of an `identity`; empty without its SHA-256."""
    return {_LEFT: left["sha256"]} if "sha256" in left else {}


def tags_beside(path: str | Path, left: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags of a raster; warn if it was made for another image than that of the `identity` ``left``."""
    tags = read_tags(path)
    if (made_for := tags.get(_LEFT)) and made_for != left.get("sha256", made_for):
        _LOG.warning("%s was made for another left image than %s: check that it is of this pair", path, left["path"])
    return tags


def _tags(path: Path) -> dict[str, str]:
    try:
        return read_tags(path)
    except InputError as error:
        raise SatIntervalsError(f"{path} cannot be read: it is damaged or something else: move it away") from error
