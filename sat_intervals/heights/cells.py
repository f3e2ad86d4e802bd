"""Compute the cells of a surface model strip by strip, each tile from the points near it, and count them."""

import math
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.fusion import calibrate, fused, without_poor_cells
from sat_intervals.heights.point_cloud import Cells, PointCloud
from sat_intervals.match.histogram import Histogram
from sat_intervals.tiling import Window

# Cells of a tile: some tens of megabytes.
_TILE_ROWS, _TILE_COLUMNS = 512, 2048
# Cells of a strip of tiles, 24 bytes each, a few strips in memory; tiles of wide surfaces have fewer rows.
_STRIP_CELLS, _LOWEST = 1 << 22, 64
# Points that reach the cells of a tile, for medians: some 60 bytes each.
_LISTED_POINTS = 1 << 22
# Widths are counted in steps of 2 cm, up to so many metres.
_STEPS, _WIDEST = 50, 1000
# Metres: half widths from this on are reported as a share.
WIDE = 20.0


def strips(
    threads: ThreadPoolExecutor, clouds: Sequence[PointCloud], cells: Cells, radius: float, choices: SurfaceChoices
) -> Iterator[tuple[int, np.ndarray, int]]:
    """Yield full-width strips from the top: first row, bands of SURFACE ``(6, rows, columns)``, number of poor cells.

    An error stops the running tiles.
    """
    ended = threading.Event()

    def tile(window: Window) -> tuple[np.ndarray, int]:
        bands = fused([cloud.splat(cells, window, radius, ended) for cloud in clouds])
        if choices.calibration is not None:
            calibrate(bands, choices.calibration)
        return bands, without_poor_cells(bands, choices.max_width, choices.min_confidence)

    rows, columns = min(_TILE_ROWS, max(_LOWEST, _STRIP_CELLS // cells.columns)), _TILE_COLUMNS
    if choices.bounds == "median":
        reaching = max(1.0, math.pi * (radius / cells.resolution) ** 2)
        of_cell = reaching * max(cloud.points_per_cell(cells.resolution) for cloud in clouds)
        rows, columns = _smaller(rows, columns, _LISTED_POINTS / of_cell)
    for row in range(0, cells.rows, rows):
        height = min(rows, cells.rows - row)
        windows = (
            Window(row, column, height, min(columns, cells.columns - column))
            for column in range(0, cells.columns, columns)
        )
        try:
            bands, poor = zip(*threads.map(tile, windows), strict=True)
        except BaseException:
            ended.set()
            raise
        yield row, np.concatenate(bands, axis=2), sum(poor)


def _smaller(rows: int, columns: int, cells: float) -> tuple[int, int]:
    """Return rows and columns of a tile of at most so many cells, halving the longer side."""
    while rows * columns > max(cells, 1):
        rows, columns = (rows, -(-columns // 2)) if columns >= rows else (-(-rows // 2), columns)
    return rows, columns


class Tally:
    """Count the cells of a surface, and their widths."""

    def __init__(self) -> None:
        self._poor = self._filled = self._shared = self._disagreeing = self._bounded = self._wide = 0
        self._widths = Histogram(0, _WIDEST, _STEPS)

    def add(self, bands: np.ndarray, poor: int) -> None:
        """Add cells, and the number of those left out as poor."""
        height, lower, upper, *_, agreement = bands
        width = upper - lower
        width = width[np.isfinite(width)]
        self._poor += poor
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
            "filled": self._filled / cells,
            "disagreeing": self._disagreeing / self._shared if self._shared else None,
            "median_half_width": None if median is None else median / 2,
            "wide": self._wide / self._bounded if self._bounded else None,
            "poor_cells": self._poor,
        }
