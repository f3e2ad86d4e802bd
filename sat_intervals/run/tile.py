"""Match one tile on a worker, or trace its paths: read, compute, write the intermediate products."""

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.kernels.confidence import ambiguity_histogram
from sat_intervals.kernels.sgm import WAVEFRONTS, Borders, Ring
from sat_intervals.match.borders import Border, Place, borders_of, trace_patch
from sat_intervals.match.normalization import Moments, PairStatistics, moments
from sat_intervals.match.patch import Patch, match_patch, patch_window, patch_windows, path_window
from sat_intervals.products import NO_DISPARITY
from sat_intervals.progress import timed
from sat_intervals.raster import Image, read_views, read_window
from sat_intervals.raster.identity import check_unchanged
from sat_intervals.run.job import Job
from sat_intervals.run.schedule import Step, needs
from sat_intervals.run.seams import seam_lines
from sat_intervals.store.borders import read_border, write_border
from sat_intervals.tiling import Tile, Views, Window

_LOG = logging.getLogger(__name__)


def measure_block(image: Image, block: Window, files: dict[str, dict[str, Any]]) -> Moments:
    """Compute the moments of a block of an image, one of ``files``; runs on a worker."""
    try:
        try:
            return moments(*read_window(image, block))
        finally:
            check_unchanged(files)
    except SatIntervalsError as error:
        error.__cause__ = error.__context__ = None
        raise


def match_tile(job: Job, tile: Tile) -> None:
    """Match one tile and write its intermediate products; runs on a worker."""
    with _logged_failure(job, tile):
        _match_tile(job, tile)


def trace_tile(job: Job, tile: Tile, wavefront: int) -> None:
    """Write the path states that a tile hands to its neighbours in a wavefront; runs on a worker."""
    with _logged_failure(job, tile):
        _trace_tile(job, tile, wavefront)


@contextmanager
def _logged_failure(job: Job, tile: Tile) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        _LOG.info(
            "tile %s failed; it is tried again at most %d times", tile.name, job.config.cluster.retries, exc_info=True
        )
        if isinstance(error, SatIntervalsError):
            error.__cause__ = error.__context__ = None  # errors of GDAL cannot be pickled
        raise


def _match_tile(job: Job, tile: Tile) -> None:
    job.store.check_space(tile)
    region, whole = job.store.grid.region, _image(job)
    seconds: dict[str, float] = {}
    views, statistics = _read(job, patch_windows(tile.core, region, whole, job.config), seconds)
    borders = _borders(job, tile, range(len(WAVEFRONTS))) if job.config.hands_states_on else None
    with timed(seconds, "match"):
        patch = match_patch(views, tile.core, region, whole, job.config, statistics, borders)
    usable = {side: int((view.state == 0).sum()) for side, view in zip(("left", "right"), views, strict=True)}
    with timed(seconds, "write"):
        files = job.store.write_arrays(tile, _tile_products(patch, tile, job), job.manifest)
    job.store.write_record(tile, {"usable_pixels": usable, "seconds": seconds, "files": files})
    _LOG.debug("tile %s: %s", tile.name, ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items()))


def _trace_tile(job: Job, tile: Tile, wavefront: int) -> None:
    region, whole = job.store.grid.region, _image(job)
    views, statistics = _read(job, patch_windows(tile.core, region, whole, job.config), {})
    borders, patch = _borders(job, tile, [wavefront]), patch_window(tile.core, region, whole, job.config)
    ring = trace_patch(views, patch, borders, wavefront, job.config, statistics)
    write_border(job.store.folder, f"{tile.name}_{wavefront}", *ring)


def _image(job: Job) -> Window:
    return Window(0, 0, job.left.height, job.left.width)


def _read(job: Job, windows: tuple[Window, Window], seconds: dict[str, float]) -> tuple[Views, PairStatistics | None]:
    """Read both images; return them with the image statistics if the matching cost needs these."""
    job.store.check(job.manifest)
    job.check_inputs()  # before any work
    statistics = job.statistics()
    try:
        with timed(seconds, "read"):
            views = read_views((job.left, job.right), windows)
    finally:  # a changed input explains a read error
        job.check_inputs()
    return views, statistics


def _borders(job: Job, tile: Tile, wavefronts: Iterable[int]) -> Borders:
    """Read the path states that a tile takes over from its neighbours."""
    grid, whole = job.store.grid, _image(job)
    found: list[dict[Place, Border]] = [{} for _ in WAVEFRONTS]
    for wavefront in wavefronts:
        for step in needs(grid, Step(tile, wavefront)):
            states = read_border(job.store.folder, step.name)
            if states is None:
                raise RunError(
                    f"the path states of tile {step.tile.name} in {job.store.folder} are missing or damaged: rerun the "
                    "same command: it resumes"
                )
            place = step.tile.grid_row - tile.grid_row, step.tile.grid_column - tile.grid_column
            inside = path_window(step.tile.core, grid.region, whole, job.config)
            found[wavefront][place] = Border(inside, Ring(*states))
    return borders_of(tile.core, grid.region, whole, job.config, found)


def _tile_products(patch: Patch, tile: Tile, job: Job) -> dict[str, np.ndarray]:
    """Return the products of the tile's core for the store."""
    raw = patch.raw
    inner = tile.core.relative_to(patch.output).slices
    arrays = {name: getattr(raw, name)[inner] for name in ("winner", "lower", "upper", "disparity", "validity")}
    if job.config.subpixel_levels == 2:
        arrays |= {name: getattr(raw, name)[inner] for name in ("lower_low", "upper_low")}
    ambiguity = raw.ambiguity[inner]
    histogram = ambiguity_histogram(ambiguity, arrays["winner"] != NO_DISPARITY, job.store.ambiguities)
    if job.config.cross_check:
        arrays |= {"right_cost": patch.right.cost, "right_winner": patch.right.winner}
    seams = seam_lines(raw, patch.output, tile.core, job.store.grid.size)
    return arrays | {"ambiguity": ambiguity, "histogram": histogram, "seams": seams}
