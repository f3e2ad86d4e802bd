"""Match the tiles of a block on a worker, or trace its paths: read, compute, write the intermediate products."""

import logging
from collections.abc import Sequence

import numpy as np

from sat_intervals.errors import RunError
from sat_intervals.kernels.confidence import ambiguity_histogram
from sat_intervals.kernels.sgm import LAST, WAVEFRONTS, Borders, Edge
from sat_intervals.match.borders import Border, Place, borders_of, in_order, rehulled, sources, trace_area
from sat_intervals.match.local_ranges import LocalRanges, narrowed
from sat_intervals.match.patch import Patch, PatchFrame, frame_area, frames_of, match_patch, patch_areas, path_window
from sat_intervals.match.schedule import Step, needs
from sat_intervals.products import NO_DISPARITY
from sat_intervals.progress import timed
from sat_intervals.run.job import Job
from sat_intervals.run.source import Source, costed, frame_of, read_source
from sat_intervals.run.workers import computing
from sat_intervals.store.arrays import numbered
from sat_intervals.store.tiles import BORDERS
from sat_intervals.tiling import Tile

Handed = dict[Place, list[Edge]]
"""What tiles hand on in a wavefront: for each view, by place in the grid of tiles."""

_LOG = logging.getLogger(__name__)


def match_or_trace(job: Job, block: Tile, wavefront: int | None) -> dict[str, float]:
    """Match a block or, in a wavefront, trace its paths; return seconds by stage. Runs on a worker, logs a failure."""
    try:
        return match_block(job, block) if wavefront is None else trace_block(job, block, wavefront)
    except Exception:
        step = block.name if wavefront is None else f"{block.name}, wavefront {wavefront},"
        _LOG.info("tile %s failed; it is tried again at most %d times", step, job.config.cluster.retries, exc_info=True)
        raise


def match_block(job: Job, block: Tile) -> dict[str, float]:
    """Match the tiles of a block and write their intermediate products, with the seconds of each."""
    read: dict[str, float] = {}
    tiles, ranges = job.store.grid.within(block.core), job.ranges()
    source = read_source(job, block, ranges, read)
    handed: list[Handed] = []
    if job.hands_states_on:
        with timed(read, "read"):
            handed = [
                _handed(job, block, wavefront, inside=len(tiles) > 1 and wavefront != LAST)
                for wavefront in range(len(WAVEFRONTS))
            ]
        tiles = in_order(LAST, tiles)  # whose states come with the matched tiles
    for tile in tiles:
        _match_tile(job, tile, source, handed, ranges, {"read": read["read"] / len(tiles)})
    if job.hands_states_on:
        _write_states(job, block, LAST, handed[LAST])
    return {}


def _match_tile(
    job: Job, tile: Tile, source: Source, handed: list[Handed], ranges: LocalRanges | None, seconds: dict[str, float]
) -> None:
    """Match a tile and write its products; add the states of the last wavefront that it hands on to ``handed``."""
    with computing(job.config.cluster):
        views, costs = costed(job, tile, source, ranges, seconds)
        seconds["match"] = seconds.get("match", 0.0) + seconds.pop("costs", 0.0)
        frame, borders = frame_of(job, tile), None
        with timed(seconds, "match"):
            if job.hands_states_on:
                borders = [_borders(job, tile, view, handed, ranges) for view in range(len(costs))]
            patch = match_patch(frame, costs, job.config, borders, ranges)
        count = costs[0].seen
        del costs, borders
        with timed(seconds, "write"):
            products = _tile_products(patch, tile, job)
            if count is not None:
                base = patch_areas(frame, job.config, ranges)[0].base
                products["count"] = count[tile.core.relative_to(base).slices]
    usable = {side: int((view.state == 0).sum()) for side, view in zip(job.images, views, strict=False)}
    if handed:
        handed[LAST][_place(tile)] = patch.leaving
    with timed(seconds, "write"):
        job.store.write_tile(tile, products, usable_pixels=usable, seconds=seconds)
    _LOG.debug("tile %s: %s", tile.name, ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items()))


def trace_block(job: Job, block: Tile, wavefront: int) -> dict[str, float]:
    """Write the path states that a block hands on in a wavefront; return seconds by stage."""
    seconds: dict[str, float] = {}
    with timed(seconds, "trace"):
        tiles, ranges = job.store.grid.within(block.core), job.ranges()
        source = read_source(job, block, ranges, seconds)
        handed = _handed(job, block, wavefront)
    with computing(job.config.cluster), timed(seconds, "trace"):
        for tile in in_order(wavefront, tiles):
            _, costs = costed(job, tile, source, ranges, seconds)
            of_wavefronts = [handed if other == wavefront else {} for other in range(len(WAVEFRONTS))]
            handed[_place(tile)] = [
                trace_area(cost, frame, _borders(job, tile, view, of_wavefronts, ranges), wavefront, job.config, ranges)
                for view, (cost, frame) in enumerate(zip(costs, _frames(job, tile), strict=True))
            ]
    with timed(seconds, "trace"):
        _write_states(job, block, wavefront, handed)
    once = {"tiles.pixels": seconds["read"], "tiles.costs": seconds.get("costs", 0.0)}  # kept for other steps
    return once | {"tiles.trace": seconds["trace"] - sum(once.values())}


def _place(tile: Tile) -> Place:
    return tile.grid_row, tile.grid_column


def _frames(job: Job, tile: Tile) -> list[PatchFrame]:
    return frames_of(frame_of(job, tile), job.config)


# ---- Path states -------------------------------------------------------------------------------------------
def _write_states(job: Job, block: Tile, wavefront: int, handed: Handed) -> None:
    """Write what the tiles of a block hand on: for each tile and view the states of its last column and row."""
    edges = [edge for tile in job.store.grid.within(block.core) for edge in handed[_place(tile)]]
    states = (states for edge in edges for states in edge)
    job.store.write(BORDERS, Step(block, wavefront).name, numbered(states))


def _handed(job: Job, block: Tile, wavefront: int, *, inside: bool = False) -> Handed:
    """Read what neighbours hand on to a block in a wavefront and, with ``inside``, its own tiles to each other."""
    grid, found = job.store.grid, Handed()
    sought = {
        (tile.grid_row + row, tile.grid_column + column)
        for tile in grid.within(block.core)
        for row, column in sources(wavefront)
    }
    steps = needs(job.blocks, Step(block, wavefront))
    for step in [*steps, Step(block, wavefront)] if inside else steps:
        tiles = grid.within(step.block.core)
        wanted = [i for i, tile in enumerate(tiles) if _place(tile) in sought]
        for i, states in zip(wanted, _states_of(job, step, wanted), strict=True):
            found[_place(tiles[i])] = states
    return found


def _states_of(job: Job, step: Step, wanted: Sequence[int]) -> list[list[Edge]]:
    """Read what some tiles of a step hand on in each view; trace it again if the file is missing or damaged."""
    count = 2 * (1 + job.config.matches_right_view)  # arrays of a tile
    numbers = [str(number) for i in wanted for number in range(i * count, (i + 1) * count)]
    file = f"{job.store.folder}/{BORDERS}/{step.name}.npz"
    arrays = job.store.read(BORDERS, step.name, numbers) if numbers else []
    if arrays is None:
        assert step.wavefront is not None
        _LOG.warning("%s is missing or damaged: it is traced again", file)
        trace_block(job, step.block, step.wavefront)
        arrays = job.store.read(BORDERS, step.name, numbers)
    if arrays is None:
        raise RunError(
            f"{file} was damaged as soon as it was written: check the disk, then rerun the same command: it resumes"
        )
    edges = [Edge(*arrays[i : i + 2]) for i in range(0, len(arrays), 2)]
    return [edges[i : i + count // 2] for i in range(0, len(edges), count // 2)]


def _borders(job: Job, tile: Tile, view: int, handed: Sequence[Handed], ranges: LocalRanges | None) -> Borders:
    """Path states that a tile takes over from its neighbours in a view, by wavefront."""
    frame = _frames(job, tile)[view]
    here = narrowed(ranges, frame_area(frame, job.config).base, job.config)
    found: list[dict[Place, Border]] = [{} for _ in WAVEFRONTS]
    for wavefront, of_tiles in enumerate(handed):
        for row, column in sources(wavefront):
            place = tile.grid_row + row, tile.grid_column + column
            if place in of_tiles:
                there = _frames(job, job.store.grid.tile(*place))[view]
                edge = of_tiles[place][view]
                if ranges:
                    edge = rehulled(edge, frame_area(there, job.config, ranges).minimum, here)
                found[wavefront][row, column] = Border(path_window(there, job.config), edge)
    return borders_of(frame, here, found)


# ---- Products ----------------------------------------------------------------------------------------------
def _tile_products(patch: Patch, tile: Tile, job: Job) -> dict[str, np.ndarray]:
    """Return the products of the tile's core for the store."""
    raw = patch.raw
    inner = tile.core.relative_to(patch.output).slices
    arrays = {name: getattr(raw, name)[inner] for name in ("winner", "lower", "upper", "disparity", "validity")}
    if job.config.has_coverage:
        arrays |= {name: getattr(raw, name)[inner] for name in ("lower_low", "upper_low")}
    ambiguity = raw.ambiguity[inner]
    histogram = ambiguity_histogram(ambiguity, arrays["winner"] != NO_DISPARITY, job.config.largest_ambiguity)
    if job.config.cross_check:
        arrays |= {"right_cost": patch.right.cost, "right_winner": patch.right.winner}
    return arrays | {"ambiguity": ambiguity, "histogram": histogram}
