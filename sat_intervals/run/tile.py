"""Match one tile on a worker: read, match, write the intermediate products."""

import logging
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.confidence import ambiguity_histogram
from sat_intervals.match.normalization import Moments, moments
from sat_intervals.match.patch import Patch, match_patch, patch_windows
from sat_intervals.products import NO_DISPARITY
from sat_intervals.progress import timed
from sat_intervals.raster import Image, read_views, read_window
from sat_intervals.raster.identity import check_unchanged
from sat_intervals.run.job import Job
from sat_intervals.run.seams import seam_lines
from sat_intervals.tiling import Tile, Window

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
    try:
        _match_tile(job, tile)
    except Exception as error:
        _LOG.info(
            "tile %s failed; it is tried again at most %d times", tile.name, job.config.cluster.retries, exc_info=True
        )
        if isinstance(error, SatIntervalsError):
            error.__cause__ = error.__context__ = None  # errors of GDAL cannot be pickled
        raise


def _match_tile(job: Job, tile: Tile) -> None:
    job.store.check(job.manifest)
    job.check_inputs()  # before any work
    job.store.check_space(tile)
    statistics = job.statistics()
    seconds: dict[str, float] = {}
    whole = Window(0, 0, job.left.height, job.left.width)
    windows = patch_windows(tile.core, whole, job.config)
    try:
        with timed(seconds, "read"):
            views = read_views((job.left, job.right), windows)
    finally:  # a changed input explains a read error
        job.check_inputs()
    with timed(seconds, "match"):
        patch = match_patch(views, tile.core, job.store.grid.region, whole, job.config, statistics)
    with timed(seconds, "write"):
        files = job.store.write_arrays(tile, _tile_products(patch, tile, job), job.manifest)
    usable = {side: int((view.state == 0).sum()) for side, view in zip(("left", "right"), views, strict=True)}
    job.store.write_record(tile, {"usable_pixels": usable, "seconds": seconds, "files": files})
    _LOG.debug("tile %s: %s", tile.name, ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items()))


def _tile_products(patch: Patch, tile: Tile, job: Job) -> dict[str, np.ndarray]:
    """Return the products of the tile's core for the store."""
    raw = patch.raw
    inner = tile.core.relative_to(patch.output).slices
    arrays = {name: getattr(raw, name)[inner] for name in ("winner", "lower", "upper", "disparity", "validity")}
    ambiguity = raw.ambiguity[inner]
    histogram = ambiguity_histogram(ambiguity, arrays["winner"] != NO_DISPARITY, job.store.ambiguities)
    if job.config.cross_check:
        arrays |= {"right_cost": patch.right.cost, "right_winner": patch.right.winner}
    seams = seam_lines(raw, patch.output, tile.core, job.store.grid.size)
    return arrays | {"ambiguity": ambiguity, "histogram": histogram, "seams": seams}
