"""Compute the cells of a surface model strip by strip, each tile from the points near it, and count them."""

import math
import threading
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.fusion import calibrate, fused, without_poor_cells
from sat_intervals.heights.point_cloud import Cells, PointCloud
from sat_intervals.match.histogram import Histogram
from sat_intervals.tiling import Window

_TILE = 1024  # side of a tile in cells: some hundred megabytes
# Cells of a strip of tiles, 24 bytes each, a few strips in memory; tiles of wide surfaces have fewer rows.
_STRIP_CELLS, _LOWEST = 1 << 21, 64
_LISTED = 1 << 24  # bounds listed for the medians of a tile: 4 bytes each
_STEPS, _WIDEST = 50, 1000  # widths are counted in steps of 2 cm, up to so many metres
WIDE = 20.0  # metres: half widths from this on are reported as a share


def strips(
    threads: ThreadPoolExecutor, clouds: Sequence[PointCloud], cells: Cells, radius: float, choices: SurfaceChoices
) -> Iterator[tuple[int, np.ndarray, Counter[str]]]:
    """Yield first row, bands of SURFACE ``(6, rows, columns)``, and counts of full-width strips from the top."""
    ended = threading.Event()

    def tile(window: Window) -> tuple[np.ndarray, Counter[str]]:
        gathered, counts = zip(*(cloud.splat(cells, window, radius, ended) for cloud in clouds), strict=True)
        bands = fused(gathered)
        if choices.calibration is not None:
            calibrate(bands, choices.calibration)
        poor = without_poor_cells(bands, choices.max_width, choices.min_confidence)
        return bands, sum(counts, Counter(poor_cells=poor))

    rows, columns = _tile_size(clouds, cells, radius, choices)
    running: deque[tuple[int, list[Future[tuple[np.ndarray, Counter[str]]]]]] = deque()

    def finished() -> tuple[int, np.ndarray, Counter[str]]:
        row, tiles = running.popleft()
        bands, counts = zip(*(future.result() for future in tiles), strict=True)
        return row, np.concatenate(bands, axis=2), sum(counts, Counter())

    try:
        for row in range(0, cells.rows, rows):
            windows = (
                Window(row, column, rows, columns).clipped(Window(0, 0, cells.rows, cells.columns))
                for column in range(0, cells.columns, columns)
            )
            running.append((row, [threads.submit(tile, window) for window in windows]))
            if len(running) > 1:  # the next strip is computed while this one is written
                yield finished()
        yield finished()
    except BaseException:  # the running tiles end, too
        ended.set()
        threads.shutdown(wait=False, cancel_futures=True)
        raise


def _tile_size(clouds: Sequence[PointCloud], cells: Cells, radius: float, choices: SurfaceChoices) -> tuple[int, int]:
    """Return rows and columns of a tile: as large as memory allows, all of the same size."""
    rows, columns = min(_TILE, max(_LOWEST, _STRIP_CELLS // cells.columns)), _TILE
    if choices.bounds == "median":
        reaching = max(1.0, math.pi * (radius / cells.resolution) ** 2)  # cells that a point reaches
        most = _LISTED / reaching * min(cloud.ground.pixel_area for cloud in clouds) / cells.resolution**2
        rows = max(1, min(rows, int(math.sqrt(most))))
        columns = max(1, min(columns, int(most / rows)))
    # equal parts
    rows, columns = (-(-whole // -(-whole // most)) for whole, most in ((cells.rows, rows), (cells.columns, columns)))
    return rows, columns


class CellCounts:
    """Count the cells of a surface, and their widths."""

    def __init__(self) -> None:
        self._counts = Counter[str]()
        self._filled = self._shared = self._disagreeing = self._bounded = self._wide = 0
        self._widths = Histogram(0, _WIDEST, _STEPS)

    def add(self, bands: np.ndarray, counts: Counter[str]) -> None:
        """Add cells, and counts of their points, see `strips`."""
        height, lower, upper, *_, agreement = bands
        width = upper - lower
        width = width[np.isfinite(width)]
        self._counts += counts
        self._filled += int(np.isfinite(height).sum())
        self._shared += int(np.isfinite(agreement).sum())
        self._disagreeing += int((agreement == 0).sum())
        self._bounded += width.size
        self._wide += int((width >= 2 * WIDE).sum())
        self._widths.add(width)

    def report(self, cells: int) -> dict[str, Any]:
        """Return the figures, see `make_surface`, with shares of so many cells."""
        median = self._widths.median()
        return {
            **{name: self._counts[name] for name in ("points", "outliers", "open", "border", "poor_cells")},
            "filled": self._filled / cells,
            "disagreeing": self._disagreeing / self._shared if self._shared else None,
            "median_half_width": None if median is None else median / 2,
            "wide": self._wide / self._bounded if self._bounded else None,
        }
