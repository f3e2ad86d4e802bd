"""Sensor models and epipolar grids of a run: given once, then read from ``geometry.json`` in its folder."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.lattice import Lattice
from sat_intervals.heights.sensors import Sensors, lattice_of, median_residual
from sat_intervals.raster import write_file
from sat_intervals.raster.identity import identity
from sat_intervals.results import Run

FILE = "geometry.json"
_KINDS = "left_model", "right_model", "left_grid", "right_grid"
_GIVE = "give --left-model, --right-model, --left-grid and --right-grid"


@dataclass(frozen=True)
class Geometry:
    """Models and grids of a run, the points of its lattice, and figures of how they fit, see `triangulate`."""

    files: tuple[Path, ...]
    sensors: Sensors
    lattice: Lattice
    report: dict[str, float]


def geometry_of(run: Run, files: Sequence[str | Path] | None = None) -> Geometry:
    """Return the geometry of a run: of the files given, which its folder then remembers, or of those it remembers.

    ``files`` are left and right RPC model, left and right epipolar grid, see `triangulate`.
    """
    paths = tuple(map(Path, files if files is not None else _remembered(run)))
    sensors = Sensors.load(*paths, left=run.left_georeferencing)
    search = run.config.disparity.minimum, run.config.disparity.maximum
    lattice = lattice_of(sensors, run.region, run.report["inputs"]["right"]["width"], *search)
    report = {"median_residual": median_residual(sensors, run.region, *search), **_beyond(sensors.left_grid, run)}
    report["lost"] = float(np.isnan(lattice.nodes[..., 0]).all(axis=2).mean())
    if files is not None:
        run.check_kept([run.out / FILE], paths)
        known = {kind: identity(str(path)) for kind, path in zip(_KINDS, paths, strict=True)}
        record = {"software": "sat-intervals", "images": _images(run)} | known
        write_file(run.out / FILE, json.dumps(record, indent=1).encode())
    return Geometry(paths, sensors, lattice, report)


def _images(run: Run) -> list[str]:
    """Return what tells the images of a run from others."""
    return [image.get("sha256", image["path"]) for image in map(run.report["inputs"].get, ("left", "right"))]


def _remembered(run: Run) -> list[str]:
    """Return the files that ``geometry.json`` names; raise if there are none, or they are not those that it means."""
    file = run.out / FILE
    try:
        record = json.loads(file.read_bytes())
        images, known = record["images"], [record[kind] for kind in _KINDS]
        paths = [str(one["path"]) for one in known]
    except FileNotFoundError as error:
        raise SatIntervalsError(f"{run.out} has no sensor models and grids yet: {_GIVE}") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SatIntervalsError(f"{file} cannot be read: {_GIVE}") from error
    if images != _images(run):
        raise SatIntervalsError(f"{file} is of other images than {run.out} now: {_GIVE}")
    for path, record in zip(paths, known, strict=True):
        if identity(path, {path: record}).get("sha256") != record.get("sha256"):
            raise SatIntervalsError(f"{path} has changed since {file} was written: {_GIVE}")
    return paths


def _beyond(grid: Any, run: Run) -> dict[str, float]:
    """Return the largest number of pixels by which a grid reaches beyond the left image, and its largest step."""
    left, (columns, rows) = run.report["inputs"]["left"], grid.points
    ends = zip((rows, columns), (left["height"], left["width"]), strict=True)
    beyond = max(max(float(-nodes[0]), float(nodes[-1]) - (size - 1)) for nodes, size in ends)
    return {"beyond": beyond, "grid_step": float(max(np.diff(rows).max(), np.diff(columns).max()))}
