"""Make the cells of a surface model strip by strip, each tile from the points near it of all runs, and count them."""

import math
import threading
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from sat_intervals.config import HeightCalibration
from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.point_cloud import Cells, PointCloud
from sat_intervals.kernels.conformal import AROUND, Margins, outwards, relief_of
from sat_intervals.kernels.gridding import BOUNDED, CONFIDENCE, COUNT, HEIGHT, LOWER, UPPER, WEIGHT
from sat_intervals.match.histogram import Histogram
from sat_intervals.products import SURFACE
from sat_intervals.tiling import Window, strips_of_windows

_TILE = 1024  # side of a tile in cells: some hundred megabytes
# Cells of a strip of tiles, 24 bytes each, a few strips in memory; tiles of wide surfaces have fewer rows.
_STRIP_CELLS, _LOWEST = 1 << 21, 64
_LISTED = 1 << 24  # bounds listed for the quantiles of a tile: 4 bytes each
_STEPS, _WIDEST = 50, 1000  # widths are counted in steps of 2 cm, up to so many metres
# Share of the weights below the height of runs that are apart; cells between heights that are.
_LOW, _APART = 1 / 3, 2.0
_NARROWEST = 0.01  # metres: narrower intervals weigh as much as one of this width
Strip = tuple[int, np.ndarray, Counter[str]]  # see `strips`
WIDE = 20.0  # metres: half widths from this on are reported as a share


def strips(
    threads: ThreadPoolExecutor, clouds: Sequence[PointCloud], cells: Cells, radius: float, choices: SurfaceChoices
) -> Iterator[Strip]:
    """Yield first row, bands of SURFACE ``(6, rows, columns)``, and counts of full-width strips from the top."""
    parts = _strips(threads, clouds, cells, radius, choices)
    for row, bands, counts in parts if choices.calibration is None else _calibrated(parts, choices.calibration):
        counts["poor_cells"] += without_poor_cells(bands, choices.max_width, None)
        yield row, bands, counts


def _calibrated(parts: Iterator[Strip], calibration: HeightCalibration) -> Iterator[Strip]:
    """Yield strips with calibrated intervals, which depend on the heights of two rows above and below."""
    strip: Strip | None = next(parts)
    margins = Margins(*calibration.table())
    above = np.empty((0, 0), np.float32)
    while strip is not None:
        following = next(parts, None)
        heights = strip[1][0]
        near = [above] * bool(above.size) + [heights] + ([following[1][0, :AROUND]] if following else [])
        relief = relief_of(np.concatenate(near))[len(above) :][: len(heights)]
        above = heights[-AROUND:].copy()
        height, lower, upper = strip[1][:3]
        strip[1][1:3] = margins.widened(height, lower, upper, relief)
        yield strip
        strip = following


def _strips(
    threads: ThreadPoolExecutor, clouds: Sequence[PointCloud], cells: Cells, radius: float, choices: SurfaceChoices
) -> Iterator[Strip]:
    """Yield strips without a calibration, and with intervals of any width."""
    ended = threading.Event()

    def tile(window: Window) -> tuple[np.ndarray, Counter[str]]:
        gathered, counts = zip(*(cloud.splat(cells, window, radius, ended) for cloud in clouds), strict=True)
        bands = fused(gathered, _APART * cells.resolution)
        poor = without_poor_cells(bands, None, choices.min_confidence)
        return bands, sum(counts, Counter(poor_cells=poor))

    rows, columns = _tile_size(clouds, cells, radius, choices)
    running: deque[tuple[int, list[Future[tuple[np.ndarray, Counter[str]]]]]] = deque()

    def finished() -> Strip:
        row, tiles = running.popleft()
        bands, counts = zip(*(future.result() for future in tiles), strict=True)
        return row, np.concatenate(bands, axis=2), sum(counts, Counter())

    try:
        for windows in strips_of_windows((cells.rows, cells.columns), rows, columns):
            running.append((windows[0].row, [threads.submit(tile, window) for window in windows]))
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
    if choices.bounds == "quantiles":
        reaching = max(1.0, math.pi * (radius / cells.resolution) ** 2)  # cells that a point reaches
        most = _LISTED / reaching * min(cloud.ground.pixel_area for cloud in clouds) / cells.resolution**2
        rows = max(AROUND, min(rows, int(math.sqrt(most))))
        columns = max(1, min(columns, int(most / rows)))
    # equal parts
    rows, columns = (-(-whole // -(-whole // most)) for whole, most in ((cells.rows, rows), (cells.columns, columns)))
    return rows, columns


def fused(gathered: Sequence[np.ndarray], apart: float) -> np.ndarray:
    """Return the bands of SURFACE, ``(6, rows, columns)`` float32, from the cells of runs, see `PointCloud.splat`.

    ``apart``: metres between heights of runs from which they are not averaged.
    """
    # Heights and middles of intervals are means weighted by ``1 / width^2``, widths those of the mean weight, not
    # divided by the root of the number of runs: errors of pairs of one place are correlated. Heights that are apart
    # have no mean: beside walls matching widens roofs, so the one with a third of the weights below it is taken. Where
    # intervals do not meet, it is their hull. Without any, all heights count.
    layers = np.stack(gathered, axis=1)  # of each layer, the cells of all runs
    count = layers[COUNT].sum(axis=0)
    weights = np.where(layers[COUNT] > 0, layers[WEIGHT], np.nan)
    heights, confidences = layers[HEIGHT] / weights, layers[CONFIDENCE] / weights
    lowers, uppers = np.where(layers[BOUNDED] > 0, layers[[LOWER, UPPER]], np.nan)
    height, lower, upper = _mean(weights, heights), lowers[0], uppers[0]
    several = np.isfinite(lowers).sum(axis=0) > 1
    meeting = np.fmax.reduce(lowers) <= np.fmin.reduce(uppers)
    if len(gathered) > 1:
        width = np.maximum(uppers - lowers, _NARROWEST)
        narrowness = np.where(np.isfinite(width).any(axis=0), 1 / width, weights)
        height = np.where(np.isfinite(width).any(axis=0), _mean(width**-2, heights), height)
        differ = np.fmax.reduce(heights) - np.fmin.reduce(heights) > apart
        height = np.where(differ, _low(narrowness, heights), height)
        middle, half = _mean(width**-2, (lowers + uppers) / 2), _mean(width**-2, width**2) ** 0.5 / 2
        lower = np.where(several & meeting, middle - half, np.fmin.reduce(lowers))
        upper = np.where(several & meeting, middle + half, np.fmax.reduce(uppers))
        lower, upper = (
            np.where(differ, end(bound, height), bound) for end, bound in ((np.fmin, lower), (np.fmax, upper))
        )
    bands = {
        "height": np.fmin(np.fmax(height, lower), upper),
        "height_lower": outwards(lower, -np.inf),
        "height_upper": outwards(upper, np.inf),
        "count": np.where(count > 0, count, np.nan),
        "confidence": _mean(weights, confidences),
        "agreement": np.where(several, meeting, np.nan),
    }
    return np.stack([bands[band.name] for band in SURFACE]).astype(np.float32)


def _low(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the least value along the first axis with a share `_LOW` of the weights up to it; NaN without anything."""
    weights = np.where(np.isfinite(values + weights), weights, 0.0)
    order = np.where(weights > 0, values, np.inf).argsort(axis=0)
    upto = np.take_along_axis(weights, order, axis=0).cumsum(axis=0)
    first = (upto >= _LOW * (1 - 1e-9) * upto[-1]).argmax(axis=0)[np.newaxis]
    return np.asarray(np.take_along_axis(values, np.take_along_axis(order, first, axis=0), axis=0)[0])


def _mean(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the weighted mean over the first axis of what is known; NaN without anything."""
    weights = np.where(np.isnan(values), np.nan, weights)
    total = np.nansum(weights, axis=0)
    total[total == 0] = np.nan
    return np.asarray(np.nansum(weights * values, axis=0) / total)


def without_poor_cells(bands: np.ndarray, max_width: float | None, min_confidence: float | None) -> int:
    """Set the cells of wider intervals or lower confidence to NaN, in place; return their number."""
    height, lower, upper, _, confidence, _ = bands
    poor = np.zeros(height.shape, np.bool_)
    if max_width is not None:
        poor |= ~(upper - lower <= max_width)
    if min_confidence is not None:
        poor |= ~(confidence >= min_confidence)
    poor &= np.isfinite(height)
    bands[:, poor] = np.nan
    return int(poor.sum())


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
