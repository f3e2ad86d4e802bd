"""Make a surface model of many raw images at once: plane sweep and semi-global matching in object space."""

import logging
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sat_intervals.config import Config, Sweep, load_config, resolved
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels import FINGERPRINT
from sat_intervals.match.ground import GroundViews
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.prepare.pair import Each, FilePair
from sat_intervals.prepare.prepared import Prepared
from sat_intervals.products import plain
from sat_intervals.progress import Progress, logged_stage
from sat_intervals.raster import Image, Projection, north_up, open_image, utm_of
from sat_intervals.raster.identity import check_not_replaced, identities, identity
from sat_intervals.raster.publishing import check_free
from sat_intervals.results import open_run
from sat_intervals.run.assemble import end_tiles
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers
from sat_intervals.run.inputs import describe_inputs
from sat_intervals.run.job import Job, Swept, job_of, kept_ground, remove_tiles
from sat_intervals.run.pair import complete_before, match_and_assemble
from sat_intervals.run.state import check_folder, outputs_of, read_report
from sat_intervals.store.lock import locked
from sat_intervals.store.manifest import digest
from sat_intervals.store.tiles import home_of
from sat_intervals.tiling import Window

ORTHO = "ortho.tif"

_LOG = logging.getLogger(__name__)

if TYPE_CHECKING:
    from sat_intervals.heights.point_cloud import Cells


class _Given(NamedTuple):
    """Cells and heights as they are given: metres, grid of a raster, CRS, geoid."""

    resolution: float
    grid: "Cells | None"
    crs: str | None
    geoid: Path | None
    heights: tuple[float, float] | None


def surface_of_many(
    images: Sequence[str | Path | Image],
    out: str | Path,
    config: Any = None,
    *,
    resolution: float | Path,
    crs: str | None = None,
    geoid: str | Path | None = None,
    heights: tuple[float, float] | None = None,
    models: Sequence[str | Path | None] = (),
    makes_ortho: bool = False,
    keep_tiles: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Make a surface model with height intervals of three or more raw images at once.

    Images are resampled to the ground at each height and compared there; semi-global matching chooses the heights
    (METHOD.md, section 20). The models are shifted to fit each other. To resume, call it again.

    Parameters
    ----------
    images
        Raw images with RPC models, paths or opened by `open_image`.
    out
        Folder for ``dsm.tif`` (the bands of `make_surface`; ``count`` is that of the images), ``validity.tif`` and
        ``run.json``.
    config
        Settings, by default those of the preset ``many``; others need its ``cost``.
    resolution, crs, geoid
        As for `make_surface`.
    heights
        Lowest and highest height of the ground, metres above ``geoid`` or the ellipsoid; by default found.
    models
        RPC models of the images, None for those in or beside an image.
    makes_ortho
        Whether to write ``ortho.tif``, too: the median of the images, resampled to the surface.
    keep_tiles, overwrite, progress
        As for `match_pair`.

    Returns
    -------
    The content of ``run.json``; ``sweep`` has the shifts (pixels) and likeness of the images, those left out, the grid,
    heights and their step.

    Raises
    ------
    SatIntervalsError
        Images, models, settings or output cannot be used, or fewer than three images are like each other.
    RunError
        Tiles failed; no output was published.
    """
    from sat_intervals.heights.dsm import checked_cells

    out, geoid = Path(out), None if geoid is None else Path(geoid)
    config = resolved(load_config(config, {"preset": "many"} if config is None else None))
    if not isinstance(config.cost, Sweep):
        raise SatIntervalsError(f"cost.method is {config.cost.method}, which compares two images: give --preset many")
    opened = _opened(images)
    if heights and not heights[0] < heights[1]:
        raise SatIntervalsError(
            f"heights are {heights[0]:g} to {heights[1]:g} m: give the lowest one, then the highest"
        )
    grid, cell, crs, _ = checked_cells(resolution, crs, None, geoid)
    given = _Given(cell, grid, crs, geoid, heights)
    check_folder(out, overwrite=overwrite, names=outputs_of(config))
    named = {f"image_{number}": image for number, image in enumerate(opened, start=1)}
    inputs = describe_inputs(named, config, {})
    outputs = [*outputs_of(config), *([ORTHO] if makes_ortho else [])]
    check_not_replaced(identities(inputs), [out / name for name in outputs], [home_of(out)])
    asked = digest(
        plain(
            {
                "made_by": [version("sat-intervals"), FINGERPRINT],
                "inputs": inputs,
                "settings": config.model_dump(mode="json", exclude={"cluster", "tiles", "products", "preset"}),
                "given": [cell, grid and asdict(grid), crs, heights],
                "files": [file and identity(str(file), {}) for file in (geoid, *models)],
            }
        )
    )
    request = digest([asked, config.model_dump(mode="json", exclude={"cluster", "preset"})])
    if makes_ortho and read_report(out) is None:
        check_free(out / ORTHO, overwrite=overwrite)
    is_made = not makes_ortho or (out / ORTHO).exists()
    if is_made and not overwrite and (before := _complete_before(out, request, keep_tiles=keep_tiles)):
        return before
    seconds = dict[str, float]()
    with Connection(config.cluster, out) as connection:
        with logged_stage(seconds, "start"):
            found = kept_ground(out, asked)
            if found is None:
                each = EachOnWorkers(connection, progress)
                found = _found(opened, models, config, each, given)
            ground, figures = found
            used = {name: named[name] for name in figures["used"]}
            level = str(geoid or "the WGS 84 ellipsoid")
            swept = Swept(used, asked, level, figures | {"request": request})
            job = _job(out, config, swept, ground, {name: inputs[name] for name in used})
            job = replace(job, overwrite=overwrite)
        with locked(out):
            report = complete_before(job) if not job.begin() else match_and_assemble(job, connection, seconds, progress)
            if makes_ortho:
                from sat_intervals.workflows.ortho import write_ortho

                write_ortho(job, ground, ORTHO, progress)
            end_tiles(job, keep_tiles=keep_tiles)
    return report


def _opened(images: Sequence[str | Path | Image]) -> list[Image]:
    """Open three images or more, each given once."""
    opened = [one if isinstance(one, Image) else open_image(one) for one in images]
    if len(opened) < 3:
        raise SatIntervalsError(f"{len(opened)} images are given: give three or more")
    for number, one in enumerate(opened):
        if (one.path, one.band) in [(other.path, other.band) for other in opened[:number]]:
            raise SatIntervalsError(f"{one.path} is given twice: give each image once")
    return opened


def _complete_before(out: Path, request: str, *, keep_tiles: bool) -> dict[str, Any] | None:
    """Return the report of a complete run of a request, and remove tiles that a death left; None without."""
    before = read_report(out)
    if not before or before.get("sweep", {}).get("request") != request:
        return None
    with locked(out):
        open_run(out)  # its files are there
        if not keep_tiles:
            remove_tiles(out)
    _LOG.warning("the run in %s was already complete", out)
    return before


def _found(
    images: Sequence[Image], models: Sequence[str | Path | None], config: Config, each: Each, given: _Given
) -> tuple[GroundViews, dict[str, Any]]:
    """Find the geometry of a sweep; return it and what ``run.json`` has of it."""
    from sat_intervals.heights.views import sensors_of
    from sat_intervals.workflows.ground import found_ground

    sensors = sensors_of(images, models)
    middle = sensors[0].model
    projection = Projection(given.crs or utm_of(middle.offset_x, middle.offset_y), given.geoid)
    projection.check(middle.offset_x, middle.offset_y)
    plan = found_ground(sensors, projection, given.resolution, config, each, given.heights, given.grid)
    search = plan.config.disparity
    ends = [plan.ground.base + plan.ground.step * end for end in (search.minimum, search.maximum)]
    of_images = [
        {"path": one.image.path, "model": one.file, "shift": plan.shifts[n].round(3).tolist(), "alike": plan.alike[n]}
        for n, one in enumerate(plan.sensors)
    ]
    return plan.ground, plain(
        {
            "images": of_images,
            "pairs": (plan.ground.pairs + 1).tolist(),
            "heights": ends,
            "step": plan.ground.step,
            "disparities": [search.minimum, search.maximum],
            "ranges": plan.ranges and plan.ranges.report(),
            "used": [f"image_{i + 1}" for i, one in enumerate(images) if one in [used.image for used in plan.sensors]],
            "left_out": [one.image.path for one in plan.left_out],
            "crs": projection.crs,
            "cells": asdict(plan.cells),
        }
    )


def _job(out: Path, config: Config, swept: Swept, ground: GroundViews, inputs: dict[str, Any]) -> Job:
    """Make the job of a sweep whose geometry is known: its left image is the grid of cells."""
    figures = swept.report
    minimum, maximum = figures["disparities"]
    changes = {"minimum": minimum, "maximum": maximum}
    config = config.model_copy(update={"disparity": config.disparity.model_copy(update=changes)})
    cells = figures["cells"]
    place = north_up(figures["crs"], cells["left"], cells["top"], cells["resolution"])
    name = str((out / outputs_of(config)[0]).absolute())
    frame = Image(name, 1, cells["rows"], cells["columns"], "float32", None, False, None, None, place)
    ranges = figures["ranges"] and LocalRanges.of_report(figures["ranges"])
    prepared = Prepared(FilePair(frame, frame), config, None, None, None, ranges, None, ground=ground)
    requested = config.disparity.model_dump(mode="json")
    return job_of(prepared, out, inputs, requested, Window(0, 0, cells["rows"], cells["columns"]), swept=swept)
