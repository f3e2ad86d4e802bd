"""Describe a finished run as a STAC item, for catalogues of images."""

import hashlib
import math
import os
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import ORTHO, SURFACE, SURFACE_OF_SWEEP, Band, interval_bands
from sat_intervals.raster import RemotePath, acquired, footprint, path_of, read_layers, read_place, read_tags
from sat_intervals.raster.publishing import write_record
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import strips

_EXTENSIONS = [
    f"https://stac-extensions.github.io/{name}/schema.json"
    for name in ("projection/v2.0.0", "file/v2.1.0", "processing/v1.1.0")
]
_COG = "image/tiff; application=geotiff; profile=cloud-optimized"
_STRIP = 1 << 22  # pixels
_SHA256 = "1220"  # code and length of a multihash
_FIRST = "1959-08-14T00:00:00Z"  # no satellite has taken an image before
_DIGITS = 7  # of degrees: 1 cm


def write_item(out: str | Path, *, taken: str | None = None, identifier: str | None = None) -> Path:
    """Write ``stac.json`` to the folder of a finished run: a STAC 1.1 item with its rasters as assets.

    ``taken`` is when the left image was taken, ISO 8601 with a time zone; by default the time in its TIFF tags. Without
    one, it is null, between the first satellite image and the end of the run. Of a sweep of many images it is null,
    between their first and last day if their tags have them all.
    ``dsm.tif``, ``ortho.tif``, ``overview.png`` and ``report.html`` are assets if they belong to this run.
    """
    run = open_run(out)
    file = run.out / "stac.json"
    run.check_kept([file])
    write_record(file, _item(run, _times(run, taken), identifier or run.out.resolve().name))
    return file


def _times(run: Run, taken: str | None) -> dict[str, str | None]:
    """Return when the left image was taken, as STAC wants it, or the first and the last image of a sweep."""
    if run.is_sweep and taken is None:
        paths = [path_of(one["path"]) for one in run.images.values()]
        days = [acquired(str(path)) if path.is_file() else None for path in paths]
        known = sorted(f"{day:%Y-%m-%d}" for day in days if day)
        if len(known) == len(days):
            first, last = f"{known[0]}T00:00:00Z", f"{known[-1]}T23:59:59Z"
            return {"datetime": None, "start_datetime": first, "end_datetime": last}
    image = path_of(run.report["inputs"]["left"]["path"])
    if taken is None and image.is_file() and (tag := read_tags(image).get("TIFFTAG_DATETIME")):
        with suppress(ValueError):
            taken = datetime.strptime(tag, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC).isoformat()
    if taken is not None:
        return {"datetime": _time(taken)}
    return {"datetime": None, "start_datetime": _FIRST, "end_datetime": _time(run.report["finished"])}


def _time(text: str) -> str:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise SatIntervalsError(f"{text} is not a time such as 2024-05-31T10:20:00Z: {error}") from error
    if moment.tzinfo is None:
        raise SatIntervalsError(f"{text} has no time zone: end it with Z or an offset such as +02:00")
    return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")


def _item(run: Run, times: dict[str, str | None], identifier: str) -> dict[str, Any]:
    assets = dict(_assets(run))
    corners = footprint(run.georeferencing, run.shape)
    if corners is None and "dsm" in assets:
        shape, place = read_place(run.out / "dsm.tif")
        corners = footprint(place, shape)
    title = f"Disparity with intervals of {Path(run.report['inputs']['left']['path']).name}"
    lineage = "dense stereo matching of an epipolar pair by sat-intervals"
    if run.is_sweep:
        title = f"Surface model with intervals of {len(run.images)} images"
        lineage = "plane sweep and semi-global matching of many images in object space by sat-intervals"
    item: dict[str, Any] = {
        "type": "Feature",
        "stac_version": "1.1.0",
        "stac_extensions": _EXTENSIONS,
        "id": identifier,
        "geometry": None,
        "properties": {
            **times,
            "created": _time(run.report["finished"]),
            "title": title,
            "processing:software": run.report["versions"],
            "processing:lineage": lineage,
            "processing:expression": {"format": "sat-intervals settings", "expression": run.report["settings"]},
        },
        "links": [_link(run, *image) for image in run.images.items()],
        "assets": assets,
    }
    if corners:
        item |= _place([[round(value, _DIGITS) for value in corner] for corner in corners])
    return item


def _place(around: list[list[float]]) -> dict[str, Any]:
    """Return geometry and box of corners; GeoJSON (RFC 7946, 3.1.9) cuts what the 180th meridian crosses."""
    longitudes, latitudes = zip(*around, strict=True)
    ends = min(latitudes), max(latitudes)
    if min(longitudes) >= -180 and max(longitudes) <= 180:
        geometry = {"type": "Polygon", "coordinates": [[*around, around[0]]]}
        return {"geometry": geometry, "bbox": [min(longitudes), ends[0], max(longitudes), ends[1]]}
    edge = math.copysign(180, max(longitudes) + min(longitudes))
    west, east = _cut(around, edge, 1), _cut(around, edge, -1)
    beyond, shift = (east, -360) if edge > 0 else (west, 360)
    beyond[:] = [[round(longitude + shift, _DIGITS), latitude] for longitude, latitude in beyond]
    rings = [[[*part, part[0]]] for part in (west, east)]
    box = [min(x for x, _ in west), ends[0], max(x for x, _ in east), ends[1]]
    return {"geometry": {"type": "MultiPolygon", "coordinates": rings}, "bbox": box}


def _cut(ring: list[list[float]], meridian: float, side: int) -> list[list[float]]:
    """Return the part of a convex ring west (``side`` 1) or east (-1) of a meridian."""
    kept: list[list[float]] = []
    for (x, y), (u, v) in zip(ring, ring[1:] + ring[:1], strict=True):
        if side * (meridian - x) >= 0:
            kept.append([x, y])
        if (meridian - x) * (meridian - u) < 0:
            kept.append([meridian, round(y + (v - y) * (meridian - x) / (u - x), _DIGITS)])
    return kept


def _link(run: Run, title: str, record: dict[str, Any]) -> dict[str, str]:
    """Return the link to an image: a local file relative to the folder, any other name as it is."""
    href = record["path"]
    if Path(href).exists() and not isinstance(run.out, RemotePath):
        href = Path(os.path.relpath(href, run.out.resolve())).as_posix()
    checksum = {"file:checksum": _SHA256 + record["sha256"]} if record.get("sha256") else {}
    return {"rel": "derived_from", "href": href, "title": title} | checksum


def _assets(run: Run) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the key and the content of each asset; surface and maps of other runs are left out."""
    if not run.is_sweep:
        bands = interval_bands(run.config.extra_bands)
        yield "intervals", _raster(run, "intervals.tif", "Disparity, its interval, confidence", bands)
    flags = "; ".join(
        f"bit {flag['bit']} {name}: {flag['meaning']}" for name, flag in run.report["validity_bits"].items()
    )
    yield "validity", _raster(run, "validity.tif", "Validity flags", (Band("validity", "", flags),))
    if run.has_current("dsm.tif"):
        bands = SURFACE_OF_SWEEP if run.is_sweep else SURFACE
        yield "dsm", _raster(run, "dsm.tif", "Surface model with intervals", bands)
        if run.ortho:
            names = ("grey level",) if run.is_sweep else ("left", "right")
            bands = tuple(Band(name, "", "image resampled to the surface") for name in names)
            yield "ortho", _raster(run, ORTHO, "Ortho-image on the surface", bands)
    report = {"title": "Settings, inputs, counts, times, versions", "type": "application/json", "roles": ["metadata"]}
    yield "report", report | _file(run.out / "run.json")
    pictures = (
        ("overview", "overview.png", "Maps", "image/png"),
        ("page", "report.html", "Maps, profiles, histograms", "text/html"),
    )
    for key, name, title, kind in pictures:
        if run.has_current(name):
            yield key, {"title": title, "type": kind, "roles": ["overview"]} | _file(run.out / name)


def _file(path: Path) -> dict[str, Any]:
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return {"href": f"./{path.name}", "file:size": path.stat().st_size, "file:checksum": _SHA256 + digest}


def _raster(run: Run, name: str, title: str, bands: tuple[Band, ...]) -> dict[str, Any]:
    path = run.out / name
    shape, place = read_place(path) if name in ("dsm.tif", ORTHO) else (run.shape, run.georeferencing)
    asset: dict[str, Any] = {"title": title, "type": _COG, "roles": ["data"]} | _file(path)
    asset |= {"proj:shape": list(shape), "proj:code": None}
    if place.crs is not None and place.transform is not None:
        code = place.crs.to_epsg()
        asset |= {"proj:code": f"EPSG:{code}"} if code else {"proj:wkt2": place.crs.to_wkt()}
        asset["proj:transform"] = list(place.transform[:6])
    return asset | {"bands": _bands(path, shape, bands)}


def _bands(path: Path, shape: tuple[int, int], bands: tuple[Band, ...]) -> list[dict[str, Any]]:
    """Return name, unit, type and statistics of the bands of a raster; all its pixels are read."""
    sums = np.zeros((3, len(bands)))
    ends = np.repeat([[np.inf], [-np.inf]], len(bands), axis=1)
    for window in strips(*shape, _STRIP):
        pixels = read_layers(path, window)
        for number, values in enumerate(pixels):
            known = values[np.isfinite(values)].astype(np.float64)
            sums[:, number] += known.size, known.sum(), np.square(known).sum()
            ends[:, number] = known.min(initial=ends[0, number]), known.max(initial=ends[1, number])
    dtype = pixels.dtype.name
    found = []
    for band, (count, total, squares), (least, most) in zip(bands, sums.T.tolist(), ends.T.tolist(), strict=True):
        statistics = {"valid_percent": 100 * count / (shape[0] * shape[1])}
        if count:
            mean = total / count
            deviation = max(squares / count - mean**2, 0.0) ** 0.5
            statistics |= {"minimum": least, "maximum": most, "mean": mean, "stddev": deviation}
        one = {"name": band.name, "description": band.meaning, "data_type": dtype, "statistics": statistics}
        one |= {"unit": band.unit} if band.unit else {}
        found.append(one | ({"nodata": "nan"} if dtype.startswith("float") else {}))
    return found
