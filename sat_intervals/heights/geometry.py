"""Sensor models and epipolar grids of a run: given once, then named by ``geometry.json`` in its folder."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sat_intervals.errors import SatIntervalsError, check_file
from sat_intervals.heights.lattice import Lattice
from sat_intervals.heights.rectify import rectified_files
from sat_intervals.progress import Progress
from sat_intervals.raster import path_of
from sat_intervals.raster.identity import absolute_in, identity, local_file, relative_in
from sat_intervals.raster.publishing import write_record
from sat_intervals.results import Run, open_run
from sat_intervals.store.manifest import changes

if TYPE_CHECKING:
    from sat_intervals.heights.sensors import Sensors

FILE = "geometry.json"
_KINDS = "left_model", "right_model", "left_grid", "right_grid"
_GIVE = "give left and right models and grids, for each OUT (--left-model, ...; in Python set_geometry)"

SUSPECT = 0.1  # metres between lines of sight above which models are suspect
# Nodes of a grid beyond the image above which it may be that of another image: CARS adds up to three.
_MOST_BEYOND = 4


@dataclass(frozen=True)
class Geometry:
    """Models and grids of a run, the points of its lattice, and figures of how they fit, see `set_geometry`."""

    run: Run
    files: list[Path]
    sensors: "Sensors"
    lattice: Lattice
    report: dict[str, float]


def set_geometry(
    out: str | Path | Run,
    left_model: str | Path,
    right_model: str | Path,
    left_grid: str | Path,
    right_grid: str | Path,
) -> dict[str, float]:
    """Note the sensor models and epipolar grids of a run in its folder, for its heights: ``geometry.json``.

    Parameters
    ----------
    out
        Folder of the finished run, or the run as it was opened.
    left_model, right_model
        RPC models of the sensor images: GeoTIFF or NITF with RPC tags, ``.RPB``, ``_RPC.TXT``, ``.geom`` or DIMAP XML.
    left_grid, right_grid
        Epipolar grids: band 1 is the sensor column, band 2 the sensor row. The geotransform gives the epipolar position
        of each node (convention of shareloc and CARS). Epipolar positions refer to the whole left image. Grids of OTB,
        known by their tag ``METADATATYPE=OTB``, have displacements instead of positions.

    Returns
    -------
    ``median_residual``, the median distance (metres) between lines of sight at some positions across the region, far
    below 0.1 m if models and grids belong to these images, for any disparities; ``beyond``, the number of pixels by
    which the left grid reaches beyond the left image, and the ``grid_step`` in pixels.
    """
    run = out if isinstance(out, Run) else open_run(out)
    run.check_pair()
    paths = [path_of(file) for file in (left_model, right_model, left_grid, right_grid)]
    run.check_kept([run.out / FILE], paths)
    _, report = _sensors(run, paths)
    known = {kind: identity(str(path)) for kind, path in zip(_KINDS, paths, strict=True)}
    record = {"software": "sat-intervals", "images": _images(run)} | known
    write_record(run.out / FILE, relative_in(run.out, record))
    return report


def geometry_of(run: Run, progress: Progress = lambda stage, done, total: None) -> Geometry:
    """Return the geometry of a run, first set if `rectify` made its pair; raise without one, or if files changed."""
    from sat_intervals.heights.sensors import lattice_of

    run.check_pair()
    images = [run.report["inputs"][side] for side in ("left", "right")]
    if not (run.out / FILE).exists() and (made := rectified_files(*(image["path"] for image in images))):
        for image in images:
            if _has_changed(image):
                raise SatIntervalsError(
                    f"{image['path']} was rectified again since {run.out} was made: match it again with --overwrite"
                )
        set_geometry(run, *made)
    paths = _noted(run)
    sensors, report = _sensors(run, paths)
    search = run.config.disparity
    lattice = lattice_of(sensors, run.region, search.minimum, search.maximum, progress)
    known = np.isfinite(lattice.nodes[..., 0]).all(axis=2)
    report["lost"] = 1 - float((known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]).mean())
    return Geometry(run, paths, sensors, lattice, report)


def _sensors(run: Run, paths: Sequence[Path]) -> "tuple[Sensors, dict[str, float]]":
    from sat_intervals.heights.sensors import Sensors, check_cover, median_residual  # needs the extra `dsm`

    sensors = Sensors.load(*paths, left=run.left_georeferencing, rows=run.rows)
    search = run.config.disparity.minimum, run.config.disparity.maximum
    check_cover(sensors, run.region, run.report["inputs"]["right"]["width"], *search)
    fit = {"median_residual": median_residual(sensors, run.region, *search)}
    return sensors, fit | _beyond(sensors.left_grid, run)


def _content(record: Mapping[str, Any]) -> Any:
    """Return what tells the content of a file from others: SHA-256, or ETag in a bucket; None without."""
    return record.get("sha256", record.get("etag"))


def _has_changed(record: Mapping[str, Any]) -> bool:
    """Return whether a file has another content than its record; RunError if its server does not answer."""
    path = record["path"]
    before, now = ({"content": _content(one)} for one in (record, identity(path, {path: record})))
    return bool(changes(path, before, now))


def _images(run: Run) -> list[str]:
    """Return what tells the images of a run from others."""
    return [_content(image) or image["path"] for image in map(run.report["inputs"].get, ("left", "right"))]


def _noted(run: Run) -> list[Path]:
    """Return the files that ``geometry.json`` names; raise if there are none, or they are not those that it means."""
    file = run.out / FILE
    try:
        record = absolute_in(run.out, json.loads(file.read_bytes()))
        images, known = record["images"], [record[kind] for kind in _KINDS]
        paths = [str(one["path"]) for one in known]
    except FileNotFoundError as error:
        raise SatIntervalsError(f"{run.out} has no sensor models and grids yet: {_GIVE}") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SatIntervalsError(f"{file} cannot be read: {_GIVE}") from error
    if images != _images(run):
        raise SatIntervalsError(f"{file} is of other images than {run.out} now: {_GIVE}")
    for path, one in zip(paths, known, strict=True):
        check_file(local_file(path) or path_of(path), _GIVE)
        if _has_changed(one):
            raise SatIntervalsError(f"{path} has changed since {file} was written: {_GIVE}")
    return [path_of(path) for path in paths]


def _beyond(grid: Any, run: Run) -> dict[str, float]:
    """Return the largest number of pixels by which a grid reaches beyond the left image, and its largest step."""
    left, (columns, rows) = run.report["inputs"]["left"], grid.points
    ends = zip((rows, columns), (left["height"], left["width"]), strict=True)
    beyond = max(max(float(-nodes[0]), float(nodes[-1]) - (size - 1)) for nodes, size in ends)
    return {"beyond": beyond, "grid_step": float(max(np.diff(rows).max(), np.diff(columns).max()))}


def geometry_warnings(reports: dict[str, Any]) -> list[str]:
    """Return lines about pixels without a point, and models that hardly fit, by the run."""
    lines = []
    for out, report in reports.items():
        if report["lost"]:
            lines.append(f"{out}: no points in {100 * report['lost']:.2g} %: grids or models have no values there")
        if report["beyond"] > _MOST_BEYOND * report["grid_step"]:
            lines.append(
                f"{out}: the left grid reaches {report['beyond']:.0f} px beyond the left image, more than "
                f"{_MOST_BEYOND} of its nodes: check that models and grids belong to these images, which must not be "
                "cropped"
            )
        if report["median_residual"] > SUSPECT:
            lines.append(
                f"{out}: lines of sight miss each other by {report['median_residual']:.2g} m in the median, "
                "where matching models and grids give millimetres. Height errors may be many times larger: check that "
                "the grids were made with these models"
            )
    return lines
