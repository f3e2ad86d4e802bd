"""Check that a pair can be matched with the memory that there is, before its tiles; what it needs on disks."""

from collections.abc import Iterable
from pathlib import Path

from sat_intervals.config import Config
from sat_intervals.errors import SatIntervalsError
from sat_intervals.machine import usable_cores
from sat_intervals.match.costs import check_cost
from sat_intervals.match.local_ranges import LocalRanges, narrowed
from sat_intervals.match.memory import check_memory, check_strips, fitted, strip_bytes, volume_bytes
from sat_intervals.match.schedule import handed_bytes
from sat_intervals.raster import BLOCK, Image, check_pair, file_bytes, open_image, part_bytes
from sat_intervals.run.state import files_of_run
from sat_intervals.run.workers import is_remote, parse_memory, readers
from sat_intervals.store.tiles import store_bytes
from sat_intervals.tiling import Grid, Window


def fitted_to_jobs(config: Config) -> Config:
    """Return the settings with tiles small enough for the memory of a job of a batch system."""
    memory = None if config.disparity.is_auto else _job_bytes(config)
    return config if memory is None else fitted(config, memory, config.cluster.cores, readers(config.cluster))


def _job_bytes(config: Config) -> int | None:
    """Return the memory of a job of a batch system for the tiles being matched: dask kills workers at 95 %."""
    if config.cluster.memory is None:
        return None
    return 9 * parse_memory(config.cluster.memory) // 10


def checked_pair(left: str | Path | Image, right: str | Path | Image, config: Config) -> tuple[Image, Image]:
    """Open the images of a pair and check that they can be matched."""
    left, right = (image if isinstance(image, Image) else open_image(image) for image in (left, right))
    check_pair(left, right, 1 if config.disparity.is_auto else config.disparity.count)
    if not config.disparity.is_auto:
        config.disparity.check_images(left.path, left.width, right.path, right.width)
    check_cost(config)
    return left, right


def checked_region(left: Image, window: Window | None) -> Window:
    """Return the region of the left image to match: the given window, or all of it."""
    whole = Window(0, 0, left.height, left.width)
    if window is None:
        return whole
    if window.height < 1 or window.width < 1 or window.clipped(whole) != window:
        raise SatIntervalsError(
            f"window at row {window.row}, column {window.column}, {window.height} x {window.width} pixels: "
            f"must be inside {left.path}, {left.height} x {left.width} pixels"
        )
    return window


def check_tiles(config: Config, region: Window, ranges: LocalRanges | None = None) -> None:
    """Raise if tiles and strips do not fit in the memory of this machine or of a job; schedulers have their own."""
    rows = min(BLOCK, region.height)
    memory = _job_bytes(config)
    if memory is not None:
        check_strips(rows, region.width, config, memory, config.cluster.cores)
    if config.cluster.kind not in ("threads", "processes"):
        return
    grid = Grid(region, config.tiles.size)
    height, width = grid.tile(0, 0).core.height, grid.tile(0, 0).core.width
    tiles_of = (narrowed(ranges, tile.core, config) for tile in grid)
    largest = max(tiles_of, key=lambda one: one.disparity.count) if ranges else config
    most = config.cluster.workers or usable_cores()
    tiles, strips = min(most, len(grid)), min(most, -(-region.height // BLOCK))
    check_memory(
        tiles * volume_bytes(height, width, largest),
        f"tiles of {height} x {width} pixels x {largest.disparity.count} disparities, {tiles} at once,",
        "choose a smaller --tile-size or fewer --workers",
    )
    check_memory(
        strips * strip_bytes(rows, region.width, config),
        f"strips of {rows} x {region.width} pixels, {strips} at once,",
        "choose fewer --workers or a narrower --window",
    )


def disk_bytes(
    grid: Grid, config: Config, images: Iterable[Image], ranges: LocalRanges | None = None
) -> tuple[int, int, int]:
    """Return the bytes of tiles and what they hand on, of parts of files, and of the files, at most."""
    region, files = grid.region, files_of_run(config)
    tiles = store_bytes(grid, has_coverage=config.has_coverage)
    handed = handed_bytes(grid, config, () if is_remote(config.cluster) else images, ranges)
    size = region.height, region.width
    return tiles + handed, part_bytes(files, *size), file_bytes(files, *size)
