"""Describe a finished run as a STAC item, for catalogues of images."""

import hashlib
import json
import logging
import os
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import BANDS, FLAGS, POINTS, SURFACE, Band
from sat_intervals.raster import Georeferencing, footprint, read_layers, read_place, read_shape
from sat_intervals.raster.published import is_points_of, is_surface_of
from sat_intervals.raster.publishing import write_file
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import strips

_EXTENSIONS = [
    f"https://stac-extensions.github.io/{name}/schema.json"
    for name in ("projection/v2.0.0", "file/v2.1.0", "processing/v1.1.0")
]
_COG = "image/tiff; application=geotiff; profile=cloud-optimized"
_VALIDITY = Band("validity", "", "; ".join(f"bit {flag.bit} {flag.name}: {flag.meaning}" for flag in FLAGS))
# Pixels of a strip.
_STRIP = 1 << 22
# Multihash code and length of SHA-256.
_SHA256 = "1220"
_DIGITS = 7  # of degrees: 1 cm
_BEGINNING = 1024  # bytes of a picture, with its notes

_LOG = logging.getLogger(__name__)


def write_item(out: str | Path, *, taken: str | None = None, identifier: str | None = None) -> Path:
    """Write ``stac.json`` to the folder of a finished run: a STAC 1.1 item with its rasters as assets.

    ``taken`` is when the left image was taken, ISO 8601 with a time zone; by default, when the run ended.
    ``points.tif``, ``dsm.tif`` and ``overview.png`` are assets if they belong to this run.
    """
    run = open_run(out)
    file = run.out / "stac.json"
    run.check_kept([file])
    item = _item(run, _time(taken or run.report["finished"]), identifier or run.out.resolve().name)
    write_file(file, (json.dumps(item, indent=1, allow_nan=False) + "\n").encode())
    return file


def _time(text: str) -> str:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise SatIntervalsError(f"{text} is not a time such as 2024-05-31T10:20:00Z: {error}") from error
    if moment.tzinfo is None:
        raise SatIntervalsError(f"{text} has no time zone: end it with Z or an offset such as +02:00")
    return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")


def _item(run: Run, taken: str, identifier: str) -> dict[str, Any]:
    place = run.georeferencing
    assets = dict(_assets(run, place))
    corners = footprint(place, run.shape)
    if corners is None and "dsm" in assets:
        shape, of_surface = read_place(run.out / "dsm.tif")
        corners = footprint(of_surface, shape)
    item: dict[str, Any] = {
        "type": "Feature",
        "stac_version": "1.1.0",
        "stac_extensions": _EXTENSIONS,
        "id": identifier,
        "geometry": None,
        "properties": {
            "datetime": taken,
            "created": _time(run.report["finished"]),
            "title": f"Disparity with intervals of {Path(run.report['inputs']['left']['path']).name}",
            "processing:software": _software(run),
            "processing:lineage": "dense stereo matching of an epipolar pair by sat-intervals",
            "processing:expression": {"format": "sat-intervals settings", "expression": run.report["settings"]},
        },
        "links": list(_links(run)),
        "assets": assets,
    }
    if corners:
        around = [[round(value, _DIGITS) for value in corner] for corner in corners]
        longitudes, latitudes = zip(*around, strict=True)
        item["geometry"] = {"type": "Polygon", "coordinates": [[*around, around[0]]]}
        item["bbox"] = [min(longitudes), min(latitudes), max(longitudes), max(latitudes)]
    return item


def _software(run: Run) -> dict[str, str]:
    versions = {name.replace("_", "-"): str(version) for name, version in run.report["versions"].items()}
    return {"sat-intervals": "unknown"} | versions


def _links(run: Run) -> Iterator[dict[str, Any]]:
    for side in ("left", "right"):
        record = run.report["inputs"][side]
        link = {"rel": "derived_from", "href": _href(record["path"], run.out), "title": f"{side} image"}
        if re.fullmatch("[0-9a-f]{64}", record.get("sha256") or ""):
            link["file:checksum"] = _SHA256 + record["sha256"]
        yield link


def _href(path: str, out: Path) -> str:
    """Return a local file relative to the folder, and any other name as it is."""
    if not Path(path).exists():
        return path
    return Path(os.path.relpath(path, out.resolve())).as_posix()


def _assets(run: Run, place: Georeferencing) -> Iterator[tuple[str, dict[str, Any]]]:
    yield "intervals", _raster(run.out / "intervals.tif", "Disparity, its interval, confidence", BANDS, place)
    yield "validity", _raster(run.out / "validity.tif", "Validity flags", (_VALIDITY,), place)
    finished = run.report["finished"]
    points, surface, picture = (run.out / name for name in ("points.tif", "dsm.tif", "overview.png"))
    if _is_taken(points, points.exists() and is_points_of(points, finished), "triangulate"):
        yield "points", _raster(points, "Longitude, latitude and height of every pixel", POINTS, place)
    if _is_taken(surface, surface.exists() and is_surface_of(surface, finished), "dsm"):
        yield "dsm", _raster(surface, "Surface model with intervals", SURFACE, read_place(surface)[1])
    report = {"title": "Settings, inputs, counts, times, versions", "type": "application/json", "roles": ["metadata"]}
    yield "report", report | _file(run.out / "run.json")
    if _is_taken(picture, _is_of_run(picture, finished), "plot"):
        yield "overview", {"title": "Maps", "type": "image/png", "roles": ["overview"]} | _file(picture)


def _is_taken(file: Path, is_of_run: bool, command: str) -> bool:
    """Return whether a file becomes an asset, and say so if it is left out."""
    if file.exists() and not is_of_run:
        _LOG.warning("%s is not of this run as it is now and is left out: rerun sat-intervals %s", file, command)
    return is_of_run


def _is_of_run(picture: Path, finished: str) -> bool:
    """Return whether a picture notes that it is of a run; a user's, or one of an earlier run, does not."""
    if not picture.is_file():
        return False
    with picture.open("rb") as stream:
        return b"Comment\0" + finished.encode() in stream.read(_BEGINNING)


def _file(path: Path) -> dict[str, Any]:
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return {"href": f"./{path.name}", "file:size": path.stat().st_size, "file:checksum": _SHA256 + digest}


def _raster(path: Path, title: str, bands: tuple[Band, ...], place: Georeferencing) -> dict[str, Any]:
    _, height, width = read_shape(path)
    asset: dict[str, Any] = {"title": title, "type": _COG, "roles": ["data"]} | _file(path)
    asset |= {"proj:shape": [height, width], "proj:code": None}
    if place.crs is not None and place.transform is not None:
        code = place.crs.to_epsg()
        asset |= {"proj:code": f"EPSG:{code}"} if code else {"proj:wkt2": place.crs.to_wkt()}
        asset["proj:transform"] = list(place.transform[:6])
    return asset | {"bands": _bands(path, (height, width), bands)}


def _bands(path: Path, shape: tuple[int, int], bands: tuple[Band, ...]) -> list[dict[str, Any]]:
    """Return name, unit, type and statistics of the bands of a raster; all its pixels are read."""
    sums = np.zeros((3, len(bands)))
    ends = np.full((2, len(bands)), np.nan)
    dtype = ""
    for window in strips(*shape, _STRIP):
        pixels = read_layers(path, window)
        dtype = pixels.dtype.name
        known = pixels.reshape(len(bands), -1)
        for number, values in enumerate(known):
            values = values[np.isfinite(values)].astype(np.float64)
            if values.size:
                sums[:, number] += values.size, values.sum(), np.square(values).sum()
                ends[0, number] = np.fmin(ends[0, number], values.min())
                ends[1, number] = np.fmax(ends[1, number], values.max())
    found = []
    for number, band in enumerate(bands):
        one: dict[str, Any] = {"name": band.name, "description": band.meaning, "data_type": dtype}
        one |= {"unit": band.unit} if band.unit else {}
        one |= {"nodata": "nan"} if dtype.startswith("float") else {}
        count, total, squares = (float(value) for value in sums[:, number])
        one["statistics"] = {"valid_percent": 100 * count / (shape[0] * shape[1])}
        if count:
            mean = total / count
            deviation = max(squares / count - mean**2, 0.0) ** 0.5
            least, largest = (float(value) for value in ends[:, number])
            one["statistics"] |= {"minimum": least, "maximum": largest, "mean": mean, "stddev": deviation}
        found.append(one)
    return found
