"""A run before it is run: tiles, work, memory, disk, and the time it will take by a sample of it."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sat_intervals.config import Cluster, Config, load_config
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.match.memory import PROCESS_BYTES, fitted, tile_bytes
from sat_intervals.raster import Image
from sat_intervals.run.cluster import tiles_at_once
from sat_intervals.run.job import check_tiles, checked_pair, checked_region, fitted_to_jobs
from sat_intervals.run.pair import match_pair
from sat_intervals.run.submit import reason
from sat_intervals.tiling import Grid, Window

# Side of the window at the centre of the image that is matched to tell the time.
SAMPLE = 512
# Bytes a pixel on the disk while a run goes on: raw products (8 to 12 as compressed), strips of the final bands, files.
_STORE_BYTES, _STRIP_BYTES, _FILE_BYTES = 12, 18, 10


@dataclass(frozen=True)
class Plan:
    """What a run will take.

    Attributes
    ----------
    tile_size, tiles
        Side of a core in pixels, as the memory allows, and number of tiles.
    workers
        Tiles in work at once.
    extra_work
        Share of the matching that goes to overlaps.
    worker_bytes
        Memory of one tile in work with its process.
    together, together_bytes
        Tiles in work at once in one process, which are all in threads, and as many as it has cores in a job of a batch
        system; and memory of that process.
    disk_bytes
        Scratch and files in the folder of the run.
    seconds
        Expected, by the sample.
    """

    tile_size: int
    tiles: int
    workers: int
    extra_work: float
    worker_bytes: int
    together: int
    together_bytes: int
    disk_bytes: int
    seconds: float


def plan(
    left: str | Path | Image,
    right: str | Path | Image,
    config: Any,
    *,
    window: Window | None = None,
    memory: int | None = None,
    workers: int | None = None,
) -> Plan:
    """Say what matching a pair will take, before anything is submitted.

    Parameters
    ----------
    left, right, config, window
        As of `match_pair`.
    memory
        Bytes that a worker may take; the tile gets smaller where it must, the search range never. By default what the
        settings give a job.
    workers
        Tiles in work at once; by default those of the settings, with batch systems all cores of all jobs, or one a core
        of this machine.

    Raises
    ------
    SatIntervalsError
        What cannot be matched, and memory in which no tile fits, with the figures.
    """
    config = load_config(config)
    config = fitted_to_jobs(config) if memory is None else fitted(config, memory)
    left, right = checked_pair(left, right, config)
    workers = workers or tiles_at_once(config.cluster)
    region = checked_region(left, window)
    check_tiles(config, region)
    grid = Grid(region, config.tiles.size)
    work = _work(grid, region, config)
    pixels = region.height * region.width
    together = {"threads": workers, "processes": 1, "address": 1}.get(config.cluster.kind, config.cluster.cores)
    return Plan(
        tile_size=config.tiles.size,
        tiles=len(grid),
        workers=workers,
        extra_work=work / pixels - 1,
        worker_bytes=PROCESS_BYTES + tile_bytes(config),
        together=together,
        together_bytes=PROCESS_BYTES + together * tile_bytes(config),
        disk_bytes=pixels * (_STORE_BYTES + _STRIP_BYTES + _FILE_BYTES),
        seconds=_expected_seconds(left, right, config, workers, work, region),
    )


def _work(grid: Grid, region: Window, config: Config) -> int:
    """Pixels that the two sweeps visit, on average of both: all of the patch but the rows behind its core."""
    overlap = config.tiles.overlap
    total = 0
    for row, rows in _kinds(grid.rows, -(-overlap // grid.size)):
        for column, columns in _kinds(grid.columns, -(-overlap // grid.size)):
            core = grid.tile(row, column).core
            patch = core.grown(overlap, overlap).clipped(region)
            total += rows * columns * (patch.width * (core.height + patch.height) // 2)
    return total


def _kinds(count: int, reach: int) -> Iterator[tuple[int, int]]:
    """Places along a grid, which may be too long to visit all, with how many are like them: those far from its ends."""
    ends = reach + 1
    if count <= 2 * ends:
        yield from ((place, 1) for place in range(count))
    else:
        yield from ((place, 1) for place in (*range(ends), *range(count - ends, count)))
        yield ends, count - 2 * ends


def _expected_seconds(left: Image, right: Image, config: Config, workers: int, work: int, region: Window) -> float:
    """Seconds of a run: those of a sample, tiles scaled by their work, the rest by pixels."""
    one = config.model_copy(update={"cluster": Cluster(workers=1)})  # nor in the store of the run itself
    with tempfile.TemporaryDirectory() as folder:
        sample, seconds = _sampled(left, right, Path(folder) / "sample", one, region)
    sampled = _work(Grid(sample, config.tiles.size), region, config)
    tiles = sum(seconds[f"tiles.{stage}"] for stage in ("read", "match", "write")) * work / sampled
    tiles /= min(workers, len(Grid(region, config.tiles.size)))
    files = (seconds["bands"] + seconds["files"]) * (region.height * region.width) / (sample.height * sample.width)
    images = seconds["tiles.images"]  # whole already, whatever the sample
    return float(seconds["start"] + seconds["kernels"] + images + tiles + files)


def _sampled(left: Image, right: Image, out: Path, config: Config, region: Window) -> tuple[Window, dict[str, float]]:
    """The window at the centre, or another where nothing can be matched there, and the seconds that it took."""
    height, width = min(SAMPLE, region.height), min(SAMPLE, region.width)
    for share in (0.5, 0.25, 0.75, 0.0, 1.0):
        row = region.row + round(share * (region.height - height))
        column = region.column + round(share * (region.width - width))
        sample = Window(row, column, height, width)
        try:
            return sample, match_pair(left, right, out, config, window=sample, overwrite=True)["seconds"]
        except RunError as error:  # its words are of a run that can be gone on with
            raise RunError(f"a sample of the pair cannot be matched: {reason(error.__cause__ or error)}") from error
        except SatIntervalsError as error:
            last = error
    raise last
