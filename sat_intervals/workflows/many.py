"""Make a surface model of many raw images at once: plane sweep and semi-global matching in object space."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sat_intervals.config import Config, HeightCalibration, Sweep, resolved, surface_key
from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.choices import SurfaceChoices, completion_of
from sat_intervals.kernels import FINGERPRINT
from sat_intervals.match.ground import GroundViews
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.prepare.pair import Each, FilePair
from sat_intervals.prepare.prepared import Prepared
from sat_intervals.products import ORTHO, Band, plain
from sat_intervals.progress import Progress, logged_stage
from sat_intervals.raster import Image, Projection, find_model, north_up, utm_of
from sat_intervals.raster.completion import Completion
from sat_intervals.raster.identity import check_not_replaced, identities, identity
from sat_intervals.raster.publishing import check_free
from sat_intervals.results import open_run
from sat_intervals.run.assemble import end_tiles
from sat_intervals.run.beside import compiled_beside
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers
from sat_intervals.run.inputs import describe_inputs
from sat_intervals.run.job import Job, Swept, job_of, kept_ground, remove_tiles
from sat_intervals.run.pair import complete_before, match_and_assemble
from sat_intervals.run.report import tags_of_sweep
from sat_intervals.run.state import check_folder, outputs_of, read_report
from sat_intervals.store.lock import locked
from sat_intervals.store.manifest import digest
from sat_intervals.store.tiles import home_of
from sat_intervals.tiling import Window

# Ends of an extent in whole cells; cells that it may have.
_ENDS = math.floor, math.floor, math.ceil, math.ceil
_MOST_CELLS = 10**11
# Of the figures of a geometry, those for batches and plans.
FIGURES = "crs", "cells", "heights", "step", "images", "left_out"

_LOG = logging.getLogger(__name__)

if TYPE_CHECKING:
    from sat_intervals.heights.point_cloud import Cells


class Wanted(NamedTuple):
    """The surface that is wanted of many images, see `surface`."""

    resolution: float | Path
    crs: str | None = None
    geoid: Path | None = None
    extent: tuple[float, float, float, float] | None = None
    heights: tuple[float, float] | None = None
    models: Sequence[str | Path | None] = ()
    choices: SurfaceChoices = SurfaceChoices()


@dataclass(frozen=True)
class Asked:
    """A sweep that is asked for and checked, before anything is found; ``digest``: of all that its geometry needs."""

    images: dict[str, Image]
    config: Config
    wanted: Wanted
    cell: float
    grid: "Cells | None"
    inputs: dict[str, Any]
    digest: str
    completion: Completion | None

    @property
    def request(self) -> str:
        """Return a digest of all that is asked for."""
        calibration = self.wanted.choices.calibration and self.wanted.choices.calibration.sha256
        settings = self.config.model_dump(mode="json", exclude={"cluster", "preset"})
        return digest([self.digest, settings, calibration, self.completion and self.completion.key])


Geometry = tuple[GroundViews, dict[str, Any]]
"""Where many images show the ground, and what ``run.json`` has of it."""


def surface_of_many(
    images: Sequence[Image],
    out: Path,
    config: Config,
    wanted: Wanted,
    *,
    keep_tiles: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Make the surface of three images or more, see `surface`; return the content of ``run.json``."""
    asked = asked_of(images, out, config, wanted, overwrite=overwrite)
    if not overwrite and (before := complete_sweep(asked, out, keep_tiles=keep_tiles)):
        return before
    seconds = dict[str, float]()
    with compiled_beside(asked.config), Connection(asked.config.cluster, out) as connection:
        with logged_stage(seconds, "start"):
            job = sweep_job(asked, out, EachOnWorkers(connection, progress), overwrite=overwrite)
        with locked(out):
            report = complete_before(job) if not job.begin() else match_and_assemble(job, connection, seconds, progress)
            if wanted.choices.ortho:
                write_ortho(job, progress)
            end_tiles(job, keep_tiles=keep_tiles)
    return report


def write_ortho(job: Job, progress: Progress) -> None:
    """Write the median of all images, resampled to the surface of a finished run; an existing file is replaced."""
    from sat_intervals.heights.ortho import write_orthos

    surface, ground = job.out / "dsm.tif", job.prepared.ground
    assert ground
    meaning = "median of the images that see the cell, resampled to the surface; no data without a height"
    write_orthos(surface, [*job.images.values()], ground, [Band("grey level", "", meaning)], progress)


def asked_of(images: Sequence[Image], out: Path, config: Config, wanted: Wanted, *, overwrite: bool = False) -> Asked:
    """Check all that can be checked before the geometry of a sweep is found."""
    from sat_intervals.heights.dsm import checked_cells

    config = resolved(config)
    if not isinstance(config.cost, Sweep):
        raise SatIntervalsError(f"cost.method is {config.cost.method}, which compares two images: give --preset many")
    if not config.disparity.is_auto:
        raise SatIntervalsError("a range of disparities is for two images: leave it out, or give heights")
    _check_images(images, wanted)
    grid, cell, crs, _ = checked_cells(wanted.resolution, wanted.crs, None, wanted.geoid)
    if wanted.extent:
        grid = _cells_of(wanted.extent, grid, cell)
    choices, completion = wanted.choices, completion_of(cell, wanted.choices)
    _check_margins(choices.calibration, config, len(images), cell)
    check_folder(out, overwrite=overwrite, names=outputs_of(config))
    named = {f"image_{number}": image for number, image in enumerate(images, start=1)}
    inputs = describe_inputs(named, config, {})
    outputs = [*outputs_of(config), *([ORTHO] if choices.ortho else [])]
    found = (model for one in images if (model := find_model(one.path)) != one.path)
    files = wanted.geoid, *(wanted.models or found)
    like = [choices.flatten, choices.mask, wanted.resolution if isinstance(wanted.resolution, Path) else None]
    check_not_replaced([*identities(inputs), *files, *like], [out / name for name in outputs], [home_of(out)])
    if choices.ortho and read_report(out) is None:
        check_free(out / ORTHO, overwrite=overwrite)
    decisive = {
        "made_by": [version("sat-intervals"), FINGERPRINT],
        "inputs": inputs,
        "settings": config.model_dump(mode="json", exclude={"cluster", "tiles", "products", "preset"}),
        "given": [cell, grid and asdict(grid), crs, wanted.heights],
        "files": [file and identity(str(file), {}) for file in files],
    }
    return Asked(named, config, wanted._replace(crs=crs), cell, grid, inputs, digest(plain(decisive)), completion)


def _check_margins(calibration: HeightCalibration | None, config: Config, images: int, cell: float) -> None:
    """Raise for margins of other surfaces, such as those of another number of images."""
    if calibration:
        calibration.check_surface(surface_key(tags_of_sweep(config, images) | {"RUNS": "this"}, cell))


def _cells_of(extent: tuple[float, float, float, float], grid: "Cells | None", cell: float) -> "Cells":
    """Return the cells of an extent: left, bottom, right and top on the map."""
    from sat_intervals.heights.point_cloud import Cells

    left, bottom, right, top = extent
    if grid or not (-math.inf < left < right < math.inf and -math.inf < bottom < top < math.inf):
        raise SatIntervalsError(
            f"extent is {left:g} {bottom:g} {right:g} {top:g}: give left, bottom, right and top on the map, in metres, "
            "and no raster whose grid is taken"
        )
    sides = (round(side / cell, 6) for side in extent)  # multiples of cells stay what they are
    first, lowest, last, highest = (end(side) for end, side in zip(_ENDS, sides, strict=True))
    if (last - first) * (highest - lowest) > _MOST_CELLS:
        raise SatIntervalsError(
            f"extent has {highest - lowest} x {last - first} cells of {cell:g} m: give a smaller one, or larger cells"
        )
    return Cells(cell * first, cell * highest, cell, highest - lowest, last - first)


def _check_images(images: Sequence[Image], wanted: Wanted) -> None:
    """Raise unless each image is given once, a model of each or of none, and heights in order."""
    for number, one in enumerate(images):
        if (one.path, one.band) in [(other.path, other.band) for other in images[:number]]:
            raise SatIntervalsError(f"{one.path} is given twice: give each image once")
    if wanted.models and len(wanted.models) != len(images):
        raise SatIntervalsError(
            f"{len(wanted.models)} models are given for {len(images)} images: give one of each image, or none"
        )
    if wanted.heights and not wanted.heights[0] < wanted.heights[1]:
        low, high = wanted.heights
        raise SatIntervalsError(f"heights are {low:g} to {high:g} m: give the lowest one, then the highest")


def complete_sweep(asked: Asked, out: Path, *, keep_tiles: bool) -> dict[str, Any] | None:
    """Return the report of a complete run of a request, and remove tiles that a death left; None without."""
    before = read_report(out)
    if not before:
        return None
    if before.get("sweep", {}).get("request") != asked.request:
        raise SatIntervalsError(f"{out} holds another run: give another folder, or --overwrite (overwrite=True)")
    if asked.wanted.choices.ortho and not (out / ORTHO).exists():
        return None
    with locked(out):
        open_run(out)  # its files are there
        if not keep_tiles:
            remove_tiles(out)
    _LOG.warning("the run in %s was already complete", out)
    return before


def sweep_job(asked: Asked, out: Path, each: Each, *, overwrite: bool = False, pair: str = "") -> Job:
    """Make the job of a sweep in a folder, with the geometry that is there, or is found."""
    geometry = kept_ground(out, asked.digest) or found_geometry(asked, each)
    return replace(geometry_job(asked, out, geometry, pair=pair), overwrite=overwrite)


def found_geometry(asked: Asked, each: Each) -> Geometry:
    """Find the geometry of a sweep."""
    from sat_intervals.heights.views import middle_of, sensors_of
    from sat_intervals.workflows.ground import found_ground

    images, wanted = list(asked.images.values()), asked.wanted
    sensors = sensors_of(images, wanted.models)
    middle = middle_of(sensors)
    projection = Projection(wanted.crs or utm_of(*middle), wanted.geoid)
    projection.check(*middle)
    plan = found_ground(sensors, projection, asked.cell, asked.config, each, wanted.heights, asked.grid)
    search = plan.config.disparity
    ends = [plan.ground.base + plan.ground.step * end for end in (search.minimum, search.maximum)]
    of_images = [
        {
            "path": one.image.path,
            "model": one.file,
            "shift": plan.fits.shift[n].round(3).tolist(),
            "slope": plan.fits.slope[n].round(3).tolist(),
            "left": plan.fits.left[n],
            "alike": plan.alike[n],
        }
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


def with_range(config: Config, figures: Mapping[str, Any]) -> Config:
    """Return settings with the steps of height that a geometry has."""
    changes = dict(zip(("minimum", "maximum"), figures["disparities"], strict=True))
    return config.model_copy(update={"disparity": config.disparity.model_copy(update=changes)})


def geometry_job(asked: Asked, out: Path, geometry: Geometry, region: Window | None = None, pair: str = "") -> Job:
    """Make the job of a sweep whose geometry is known: its left image is the grid of cells."""
    (ground, figures), cells = geometry, geometry[1]["cells"]
    place = north_up(figures["crs"], cells["left"], cells["top"], cells["resolution"])
    _check_margins(asked.wanted.choices.calibration, asked.config, len(figures["used"]), cells["resolution"])
    swept = Swept(
        {name: asked.images[name] for name in figures["used"]},
        asked.digest,
        str(asked.wanted.geoid or "the WGS 84 ellipsoid"),
        figures | {"request": asked.request},
        asked.wanted.choices.calibration,
        asked.completion and asked.completion.on(place, (cells["rows"], cells["columns"])),
    )
    config = with_range(asked.config, figures)
    name = str((out / outputs_of(config)[0]).absolute())
    frame = Image(name, 1, cells["rows"], cells["columns"], "float32", None, False, None, None, place)
    ranges = figures["ranges"] and LocalRanges.of_report(figures["ranges"])
    prepared = Prepared(FilePair(frame, frame), config, None, None, None, ranges, None, ground=ground)
    inputs = {name: asked.inputs[name] for name in swept.images}
    requested = asked.config.disparity.model_dump(mode="json")
    region = region or Window(0, 0, cells["rows"], cells["columns"])
    return job_of(prepared, out, inputs, requested, region, pair=pair, swept=swept)
