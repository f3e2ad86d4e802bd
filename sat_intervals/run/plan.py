"""Plan a run: tiles, work, memory, disk, and the time estimated from a sample."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sat_intervals.config import Cluster, Config, load_config, resolved
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.match.memory import PROCESS_BYTES, check_strips, fitted, strip_bytes, tile_bytes, waiting_bytes
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.progress import Progress
from sat_intervals.raster import BLOCK, Image
from sat_intervals.run.checks import check_tiles, checked_pair, checked_region, disk_bytes, fitted_to_jobs
from sat_intervals.run.pair import match_pair
from sat_intervals.run.preparing import prepared_here
from sat_intervals.run.workers import cores_of_process, readers, reason, tiles_at_once
from sat_intervals.tiling import Grid, Window

# Side of the sample, a window at the centre of the image; with exact seams up to twice as high and four times as wide.
SAMPLE = 512


@dataclass(frozen=True)
class Plan:
    """Resources that a run needs: pixels, bytes, seconds; ``workers`` tiles at once, ``together`` in one process.

    ``sweep`` is what was found of many images: grid, heights and their step, shifts.
    """

    search_range: tuple[int, int]
    tile_size: int
    tiles: int
    workers: int
    extra_work: float
    worker_bytes: int
    together: int
    together_bytes: int
    disk_bytes: int
    seconds: float
    sweep: dict[str, Any] | None = None


Sample = Callable[[Path, Config, Window], dict[str, float]]
"""Matches a window in a folder of its own; returns the seconds of the stages."""


def plan(
    left: str | Path | Image,
    right: str | Path | Image,
    config: Any,
    *,
    window: Window | None = None,
    memory: int | None = None,
    workers: int | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Plan:
    """Estimate tiles, memory, disk and time of matching a pair; parameters as in `match_pair`.

    ``memory`` is that of a worker in bytes, by default of a job in the settings; tiles are made smaller to fit.
    ``workers`` is the number of tiles at once, by default that of the settings.
    """
    config = resolved(load_config(config))
    left, right = checked_pair(left, right, config)
    region = checked_region(left, window)
    config = found_range(left, right, config, progress)

    def sample(out: Path, one: Config, window: Window) -> dict[str, float]:
        progress("kernels", 0, 1)
        compile_kernels(one)  # once a machine: a part of the first plan, not of the run
        return dict(match_pair(left, right, out, one, window=window, overwrite=True)["seconds"])

    return planned((left, right), region, config, sample, memory=memory, workers=workers)


def found_range(left: Image, right: Image, config: Config, progress: Progress) -> Config:
    """Return settings with the search range that they give, or that is found."""
    if not (config.disparity.is_auto or config.disparity.is_local):
        return config
    found = prepared_here(left, right, config, progress, measures_rows=False)
    return config.model_copy(update={"disparity": found.config.disparity})


def planned(
    images: Sequence[Image],
    region: Window,
    config: Config,
    sample: Sample,
    *,
    memory: int | None = None,
    workers: int | None = None,
    within: Window | None = None,
) -> Plan:
    """Estimate what a run needs whose search range is known, see `plan`; the sample is in the region, or ``within``."""
    config = fitted_to_jobs(config) if memory is None else fitted(config, memory, waiting=readers(config.cluster))
    workers = workers or tiles_at_once(config.cluster)
    strip = min(BLOCK, region.height), region.width
    if memory is not None:
        check_strips(*strip, config, memory)
    check_tiles(config, region)
    grid = Grid(region, config.tiles.size)
    seconds, extra = _expected(sample, config, workers, grid, within or region)
    together = workers if config.cluster.kind == "threads" else cores_of_process(config.cluster)
    waiting = readers(config.cluster) * waiting_bytes(config)
    task = max(tile_bytes(config), strip_bytes(*strip, config))
    return Plan(
        search_range=(int(config.disparity.minimum), int(config.disparity.maximum)),
        tile_size=config.tiles.size,
        tiles=len(grid),
        workers=workers,
        extra_work=extra,
        worker_bytes=PROCESS_BYTES + waiting + task,
        together=together,
        together_bytes=PROCESS_BYTES + waiting + together * task,
        disk_bytes=sum(disk_bytes(grid, config, images)),
        seconds=seconds,
    )


def _work(grid: Grid, config: Config) -> int:
    """Return the pixels visited per SGM sweep, averaged over both: the patch without the rows after its core."""
    if config.tiles.overlap == "exact":
        return grid.region.height * grid.region.width

    def patch(core: Window) -> Window:
        return core.grown(config.tiles.margin, config.tiles.margin).clipped(grid.region)

    rows = [grid.tile(row, 0).core for row in range(grid.rows)]
    columns = [grid.tile(0, column).core for column in range(grid.columns)]
    return sum(core.height + patch(core).height for core in rows) * sum(patch(core).width for core in columns) // 2


def _expected(sample: Sample, config: Config, workers: int, grid: Grid, within: Window) -> tuple[float, float]:
    """Estimate the seconds of a run from a sample, and its extra work."""
    one = config.model_copy(update={"cluster": Cluster(workers=1)})  # also without the store of the run
    shape = SAMPLE, SAMPLE
    if config.hands_states_on:  # two tiles, since the sample needs a seam; whole ones, since each takes time of its own
        size = min(SAMPLE if config.cost.precomputed else 2 * SAMPLE, config.tiles.size)
        one = one.model_copy(update={"tiles": config.tiles.model_copy(update={"size": size})})
        shape = size, 2 * size
    with tempfile.TemporaryDirectory() as folder:
        window, seconds = _sampled(sample, Path(folder) / "sample", one, within, shape)
    pixels = grid.region.height * grid.region.width
    larger = pixels / (window.height * window.width)
    of_tiles = sum(seconds.get(f"tiles.{stage}", 0.0) for stage in ("read", "pixels", "costs", "match", "write"))
    work = _work(grid, config)
    tiles = of_tiles * work / _work(Grid(window, one.tiles.size), one)
    # In the sample one of two tiles hands states on, in four wavefronts; in the run all but the last do, in three.
    paths = 1.5 * larger * seconds.get("tiles.trace", 0.0) * (1 - 1 / len(grid))
    once = sum(seconds.get(stage, 0.0) for stage in ("start", "kernels", "inputs"))  # of whole images
    of_rows = sum(seconds.get(stage, 0.0) for stage in ("resampling", "bands", "cells"))
    strips = larger * of_rows / min(workers, -(-grid.region.height // BLOCK))
    extra = paths / tiles if config.hands_states_on else work / pixels - 1
    return once + (tiles + paths) / min(workers, len(grid)) + strips + larger * seconds["files"], extra


def _sampled(
    sample: Sample, out: Path, config: Config, region: Window, shape: tuple[int, int]
) -> tuple[Window, dict[str, float]]:
    """Match a sample at the centre, or elsewhere if that has no data; return its window and the seconds."""
    height, width = min(shape[0], region.height), min(shape[1], region.width)
    for share in (0.5, 0.25, 0.75, 0.0, 1.0):
        row = region.row + round(share * (region.height - height))
        column = region.column + round(share * (region.width - width))
        window = Window(row, column, height, width)
        try:
            return window, sample(out, config, window)
        except RunError as error:  # its advice to resume does not apply to a sample
            raise RunError(f"a sample cannot be matched: {reason(error.__cause__ or error)}") from error
        except SatIntervalsError as error:
            last = error
    raise last
