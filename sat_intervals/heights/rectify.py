"""Make an epipolar pair of two raw images, with its grids and a record of how it was made: ``rectify.json``."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sat_intervals.errors import ChangedInputError, SatIntervalsError, check_file
from sat_intervals.prepare.pair import Pool
from sat_intervals.products import Band, plain
from sat_intervals.raster import File, Georeferencing, Image, OutputWriter, check_not_replaced, describe, path_of
from sat_intervals.raster.identity import absolute_in, identities, identity, relative_in
from sat_intervals.raster.publishing import check_free, write_record
from sat_intervals.results import open_input
from sat_intervals.store.lock import locked
from sat_intervals.store.manifest import differences

if TYPE_CHECKING:
    from sat_intervals.heights.epipolar import Epipolar, Terrain
    from sat_intervals.heights.models import SensorImage

FILE = "rectify.json"
IMAGES = "left.tif", "right.tif"
GRIDS = "left_grid.tif", "right_grid.tif"

_GREY = (Band("grey level", "", "grey level of the raw image, resampled to epipolar geometry (cubic)"),)
_NODES = (
    Band("column", "px", "column in the raw image of an epipolar position, first pixel centre at 0.5"),
    Band("row", "px", "row in the raw image of an epipolar position, first pixel centre at 0.5"),
)
_TAGS = {"SOFTWARE": "sat-intervals"}

Compare = Callable[[Path, Path], dict[str, Any]]
"""Compares the rows of two epipolar images; what it returns is recorded."""


@dataclass(frozen=True)
class RawPair:
    """Two raw images, their models (None: those that belong to them), and what they are resampled to.

    ``side`` is that of the part in the middle that is made, in pixels; by default all is.
    """

    left: Image
    right: Image
    models: tuple[Path | None, Path | None]
    terrain: "Terrain"
    resolution_of: str = "coarser"
    side: int | None = None


def make_pair(
    pair: RawPair,
    out: Path,
    pool: Pool,
    *,
    overwrite: bool = False,
    compare: Compare | None = None,
) -> dict[str, Any]:
    """Write images, grids and record of a pair to a folder, unless it has them, and return the record."""
    from sat_intervals.heights.models import SensorImage

    pair.terrain.check()
    if rectified_files(pair.left.path, pair.right.path):
        raise SatIntervalsError(f"{pair.left.path} and {pair.right.path} are an epipolar pair already: match them")
    pool.progress("geometry", 0, 1)
    readings = [SensorImage.readings(*one) for one in zip((pair.left, pair.right), pair.models, strict=True)]
    with locked(out):
        record = read_record(out) or {}
        asked = _asked(pair, readings[0][0], readings[1][0], record.get("inputs", {}))
        if _is_needed(out, asked, record, overwrite=overwrite):
            record = _make(pair, readings, out, asked, pool)
        if compare and record["rows"] is None:
            record["rows"] = compare(*(out / name for name in IMAGES))
            _note(out, record)
    return record


def _make(
    pair: RawPair, readings: "Sequence[Sequence[SensorImage]]", out: Path, asked: dict[str, Any], pool: Pool
) -> dict[str, Any]:
    """Write all files; return the record."""
    from sat_intervals.heights.epipolar import epipolar_geometry, grid_place
    from sat_intervals.heights.ground import read_with_ground
    from sat_intervals.heights.resampling import nodata_of

    is_needed = pair.terrain.altitude is None and not pair.terrain.dem
    left, right, ground = read_with_ground(*readings, is_needed=is_needed)
    whole = epipolar_geometry(left, right, pair.terrain, pair.resolution_of, ground)
    geometry = whole.middle(pair.side) if pair.side else whole
    files = [
        File(name, one.image.dtype, nodata_of(one.image), _GREY)
        for name, one in zip(IMAGES, (left, right), strict=True)
    ]
    rows, columns, _ = geometry.left.shape
    of_grids = [File(name, "float64", None, _NODES) for name in GRIDS]
    with (
        OutputWriter(out, files, geometry.height, geometry.width, Georeferencing(), _TAGS) as images,
        OutputWriter(out, of_grids, rows, columns, grid_place(), _TAGS) as grids,
    ):
        _write_images(images, (left, right), geometry, pool)
        grids.write(0, *(np.moveaxis(nodes[..., ::-1], -1, 0) for nodes in (geometry.left, geometry.right)))
        if changes := list(differences(asked, _asked(pair, left, right, {}))):
            raise ChangedInputError(f"an input was changed meanwhile ({'; '.join(changes)}): rerun the command")
        # from now on, files in the folder may be what a death of this command has left
        _note(out, asked | {"finished": None})
        images.publish()
        grids.publish()
    more = {"bounds": "the upper bound of the disparity is the lower height", "rows": None}
    record = asked | whole.figures | {"size": [whole.height, whole.width]} | more
    record["finished"] = datetime.now(UTC).isoformat(timespec="seconds")
    _note(out, record)
    return record


def _note(out: Path, record: dict[str, Any]) -> None:
    write_record(out / FILE, relative_in(out, record))


def _asked(pair: RawPair, left: "SensorImage", right: "SensorImage", known: dict[str, Any]) -> dict[str, Any]:
    """Return inputs and settings, as ``rectify.json`` has them; ``known`` are earlier inputs."""
    files = identities(known)
    inputs = {
        "left": describe(pair.left, files),
        "right": describe(pair.right, files),
        "left_model": identity(left.file, files),
        "right_model": identity(right.file, files),
    }
    terrain = pair.terrain
    given = (("dem", terrain.dem), ("geoid", terrain.geoid))
    inputs |= {name: identity(str(file), files) for name, file in given if file}
    settings = {"altitude": terrain.altitude, "resolution_of": pair.resolution_of}
    asked = {"software": f"sat-intervals {version('sat-intervals')}", "inputs": inputs, "settings": settings}
    return dict(plain(asked))


def _is_needed(out: Path, asked: dict[str, Any], before: dict[str, Any], *, overwrite: bool) -> bool:
    """Return whether there is something to do; raise if files in the folder are not of this pair."""
    files = [out / name for name in (*IMAGES, *GRIDS)]
    check_not_replaced(identities(asked["inputs"]), [*files, out / FILE])
    is_finished = bool(before.get("finished"))
    changes = list(differences({name: before.get(name) for name in asked}, asked)) if is_finished else []
    if is_finished and not changes and all(file.exists() for file in files):
        return False
    if changes and not overwrite:
        raise SatIntervalsError(
            f"{out} already holds a pair made otherwise: {'; '.join(changes)}: choose another folder or --overwrite"
        )
    if not before:
        for file in (*files, out / FILE):
            check_free(file, overwrite=overwrite)
    return True


def _write_images(
    writer: OutputWriter, images: "tuple[SensorImage, SensorImage]", geometry: "Epipolar", pool: Pool
) -> None:
    from sat_intervals.heights.resampling import Resampled, nodata_of, nodes_near, resampled_rows

    resampled = [
        Resampled(one.image, nodes_near(nodes - one.origin - 0.5, one.image, scale), scale, nodata_of(one.image))
        for one, nodes, scale in zip(images, (geometry.left, geometry.right), geometry.scales, strict=True)
    ]
    pool.write_rows(writer, resampled_rows, lambda rows: ([one.of_rows(rows) for one in resampled], rows), "resampling")


def read_record(folder: Path) -> dict[str, Any] | None:
    """Read the record of a folder; None if there is none, or another file of this name."""
    try:
        record = absolute_in(folder, json.loads((folder / FILE).read_bytes()))
        return record if record.keys() >= {"inputs", "settings", "finished"} else None
    except (FileNotFoundError, NotADirectoryError, ValueError, AttributeError):
        return None
    except OSError as error:
        raise SatIntervalsError(f"{folder / FILE} cannot be read: {error.strerror}: choose another folder") from error


def rectified_files(left: str | Path, right: str | Path) -> tuple[Path, Path, Path, Path] | None:
    """Return models and grids of an epipolar pair that `rectify` has made; None if it has not."""
    (left, right), folder = map(path_of, (left, right)), path_of(left).parent
    if right.parent != folder or (left.name, right.name) != IMAGES:
        return None
    record = read_record(folder)
    if record is None:
        return None
    if not record["finished"]:
        raise SatIntervalsError(f"{folder} holds an unfinished pair: rerun rectify")
    left_model, right_model = (path_of(record["inputs"][f"{side}_model"]["path"]) for side in ("left", "right"))
    return left_model, right_model, folder / GRIDS[0], folder / GRIDS[1]


def raw_inputs(left: str | Path, right: str | Path) -> dict[str, Any]:
    """Return the records of raw images and models of an epipolar pair; raise if `rectify` has not made it."""
    if not rectified_files(left, right):
        raise SatIntervalsError(
            f"{left} was not rectified by sat-intervals, so its raw image is unknown: leave out ortho"
        )
    inputs = dict((read_record(path_of(left).parent) or {})["inputs"])
    for side in ("left", "right"):
        open_input(inputs[side])  # raises if it is missing
        check_file(path_of(inputs[f"{side}_model"]["path"]), "its model is needed for an ortho-image")
    return inputs
