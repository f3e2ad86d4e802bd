"""Match one tile on a worker, or trace its paths: read, compute, write the intermediate products."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.kernels.confidence import ambiguity_histogram
from sat_intervals.kernels.cost import padded_to_lanes
from sat_intervals.kernels.sgm import LAST, WAVEFRONTS, Borders, Ring
from sat_intervals.match.borders import Border, Place, borders_of, rehulled, trace_area
from sat_intervals.match.local_ranges import LocalRanges, narrowed
from sat_intervals.match.matching_cost import Area, MatchingCost, cost_areas, view_windows
from sat_intervals.match.normalization import Moments, PairStatistics, moments
from sat_intervals.match.patch import (
    Frame,
    Patch,
    frame_area,
    frames_of,
    match_costed,
    mirrored_frame,
    patch_areas,
    path_window,
)
from sat_intervals.match.sampling import Look, look_in_tile
from sat_intervals.products import NO_DISPARITY
from sat_intervals.progress import timed
from sat_intervals.raster import Image, read_views, read_window
from sat_intervals.raster.identity import check_unchanged
from sat_intervals.run.job import Job
from sat_intervals.run.schedule import Step, needs
from sat_intervals.run.seams import seam_lines
from sat_intervals.store.removal import BORDERS, COSTS
from sat_intervals.tiling import Tile, Views, Window

# Tiles along each side of the grid, at most, in which the quality of a pair is looked at.
_LOOKS = 4

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
    with _logged_failure(job, tile.name):
        _match_tile(job, tile)


def trace_tile(job: Job, tile: Tile, wavefront: int, mirrored: bool) -> dict[str, float]:
    """Write the path states that a tile hands on in a wavefront; return seconds by stage; runs on a worker."""
    with _logged_failure(job, Step(tile, wavefront, mirrored).name):
        return _trace_tile(job, tile, wavefront, mirrored)


@contextmanager
def _logged_failure(job: Job, step: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        _LOG.info("tile %s failed; it is tried again at most %d times", step, job.config.cluster.retries, exc_info=True)
        if isinstance(error, SatIntervalsError):
            error.__cause__ = error.__context__ = None  # errors of GDAL cannot be pickled
        raise


def _match_tile(job: Job, tile: Tile) -> None:
    job.store.check_space(tile)
    frame, borders = _frame(job, tile), None
    seconds: dict[str, float] = {}
    ranges = job.ranges()
    costed = _costs(job, patch_areas(*frame[:3], job.config, ranges), tile, seconds)
    if job.hands_states_on:
        with timed(seconds, "read"):
            frames = frames_of(*frame[:3], job.config)
            borders = [_borders(job, tile, of_view, range(len(WAVEFRONTS)), ranges) for of_view in frames]
    seconds["match"] = seconds.get("match", 0.0) + seconds.pop("costs", 0.0)
    with timed(seconds, "match"):
        patch = match_costed(costed.views, frame, costed.made, job.config, borders, ranges)
    usable = {side: int((view.state == 0).sum()) for side, view in zip(("left", "right"), costed.views, strict=True)}
    with timed(seconds, "write"):
        if job.hands_states_on:
            for mirrored, ring in enumerate(patch.leaving):
                job.store.write_step(BORDERS, Step(tile, LAST, bool(mirrored)).name, *ring)
        files = job.store.write_arrays(tile, _tile_products(patch, tile, job), job.manifest)
    looks = [look._asdict() for look in _looks(costed.views, tile, job)]
    job.store.write_record(tile, {"usable_pixels": usable, "seconds": seconds, "files": files, "looks": looks})
    _LOG.debug("tile %s: %s", tile.name, ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items()))


def _looks(views: Views, tile: Tile, job: Job) -> list[Look]:
    """Look at the quality of the pair in some of the tiles, unless the search for its range did so."""
    grid, search = job.store.grid, job.config.disparity
    if job.found or tile.grid_row % -(-grid.rows // _LOOKS) or tile.grid_column % -(-grid.columns // _LOOKS):
        return []
    return look_in_tile(views, tile.core, search.minimum, search.maximum)


def _trace_tile(job: Job, tile: Tile, wavefront: int, mirrored: bool) -> dict[str, float]:
    frame, ranges = _frame(job, tile), job.ranges()
    if mirrored:
        frame = mirrored_frame(frame, job.config)
    seconds: dict[str, float] = {}
    with timed(seconds, "trace"):
        (cost,) = _costs(job, [frame_area(frame, job.config, ranges)], tile, seconds).made
        borders = _borders(job, tile, frame, [wavefront], ranges)
        ring = trace_area(cost, frame, borders, wavefront, job.config, ranges)
        job.store.write_step(BORDERS, Step(tile, wavefront, mirrored).name, *ring)
    costs = seconds.get("costs", 0.0)
    return {"tiles.costs": costs, "tiles.trace": seconds["trace"] - costs}


def _frame(job: Job, tile: Tile) -> Frame:
    return Frame(tile.core, job.store.grid.region, Window(0, 0, job.left.height, job.left.width))


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


class _Costed(NamedTuple):
    """Both images in the windows of some areas, and the costs of these."""

    views: Views
    made: list[MatchingCost]


def _costs(job: Job, areas: Sequence[Area], tile: Tile, seconds: dict[str, float]) -> _Costed:
    """Read both images and compute the costs of a tile's areas.

    Precomputed costs take longer than SGM: the first of the tile's steps keeps them for the others, uncompressed, since
    those of noisy images do not shrink.
    """
    views, statistics = _read(job, view_windows(areas, job.config), seconds)
    if not (job.config.cost.precomputed and job.hands_states_on):
        with timed(seconds, "match"):
            return _Costed(views, cost_areas(views, areas, job.config, statistics))
    names = [f"{tile.name}_right" if area.mirrored else tile.name for area in areas]
    with timed(seconds, "read"):
        kept = [costs for name in names for costs in job.store.read_step(COSTS, name) or ()]
    if len(kept) == len(names):
        missing = [padded_to_lanes(costs.shape[2]) - costs.shape[2] for costs in kept]
        made = [np.pad(costs, [(0, 0), (0, 0), (0, more)]) for costs, more in zip(kept, missing, strict=True)]
        with timed(seconds, "match"):
            return _Costed(views, cost_areas(views, areas, job.config, statistics, made))
    with timed(seconds, "costs"):
        costed = cost_areas(views, areas, job.config, statistics)
        for name, area, cost in zip(names, areas, costed, strict=True):
            job.store.write_step(COSTS, name, cost.costs.left[:, :, : area.disparities])
    return _Costed(views, costed)


def _borders(job: Job, tile: Tile, frame: Frame, wavefronts: Iterable[int], ranges: LocalRanges | None) -> Borders:
    """Read the path states that a tile takes over from its neighbours in a view."""
    here = narrowed(ranges, frame_area(frame, job.config).base, job.config)
    found: list[dict[Place, Border]] = [{} for _ in WAVEFRONTS]
    for wavefront in wavefronts:
        for step in needs(job.store.grid, Step(tile, wavefront, frame.mirrored)):
            states = job.store.read_step(BORDERS, step.name)
            if states is None:
                raise RunError(
                    f"the path states of tile {step.tile.name} in {job.store.folder} are missing or damaged: rerun the "
                    "same command: it resumes"
                )
            place = step.tile.grid_row - tile.grid_row, step.tile.grid_column - tile.grid_column
            there = _frame(job, step.tile)
            if frame.mirrored:
                there = mirrored_frame(there, job.config)
            ring = Ring(*states)
            if ranges:
                ring = rehulled(ring, frame_area(there, job.config, ranges).minimum, here)
            found[wavefront][place] = Border(path_window(there, job.config), ring)
    return borders_of(frame, here, found)


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
