"""Areas of change: connected cells of one sign, their mean differences and volumes, with standard deviations.

An area has enough cells that are significant at the named rate; cells beside them that are likely to have changed
belong to it, too.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.evaluate.change import Pair
from sat_intervals.heights.polygons import read_areas
from sat_intervals.kernels.change import connected, painted
from sat_intervals.kernels.significance import ratio_of
from sat_intervals.raster.polygons import Polygon, outline
from sat_intervals.tiling import Window

# Probability without a change up to which cells beside an area belong to it: half as many cells again of blocks of 7 to
# 10 m, and on unchanged ground at most .008 of the cells in areas at a rate of .01, as many areas as without.
_LIKELY = 0.2

Chosen = Callable[[Window], np.ndarray]
"""Which cells of a window are chosen."""


def stable_ground(path: Path | None, pair: Pair) -> Chosen:
    """Open a raster that is not 0 on stable ground, or polygons of it; None is no ground."""
    place = pair.before.place
    if path is None:
        return lambda window: np.zeros((window.height, window.width), bool)
    areas = read_areas(path).on(place, pair.before.shape)
    return lambda window: areas.numbers(place.shifted(window), (window.height, window.width)) > 0


def signs_of(pair: Pair, false_alarms: float, stable: Chosen) -> tuple[np.ndarray, dict[str, int]]:
    """Find the cells that changed at a rate of false alarms: 2 risen, 1 likely, 0, -1, -2 fallen, a byte each.

    Returns numbers of cells, too: ``compared``, of these on ``stable`` ground, and of these ``false``.
    """
    signs, counts = np.zeros(pair.before.shape, np.int8), np.zeros(3, np.int64)
    limit, likely = (ratio_of(rate, pair.scale) for rate in (false_alarms, max(false_alarms, _LIKELY)))
    for window in pair.strips():
        ratio = pair.read(window).ratio
        known, found = np.isfinite(ratio), np.abs(ratio) >= limit
        signs[window.slices] = np.sign(np.nan_to_num(ratio)) * (found * 1 + (np.abs(ratio) >= likely))
        checked = known & stable(window)
        counts += known.sum(), checked.sum(), (checked & found).sum()
    return signs, dict(zip(("compared", "stable", "false"), counts.tolist(), strict=True))


class Areas:
    """The areas of a pair, from 1: those that rose, then those that fell. `add` strips first."""

    def __init__(self, pair: Pair, signs: np.ndarray, smallest: float) -> None:
        """``smallest`` area is in square metres."""
        self._pair = pair
        self._cell = float(np.prod(pair.before.place.pixel_size))
        least = int(np.clip(np.ceil(smallest / self._cell - 1e-9), 1, signs.size + 1))
        self._runs = [connected(signs, sign, least) for sign in (1, -1)]
        self._risen, fallen = (int(runs[2].max(initial=0)) for runs in self._runs)
        # cells, differences, deviations, slopes to the east and to the north
        self._sums = np.zeros((5, 1 + self._risen + fallen))

    def labels(self, window: Window) -> np.ndarray:
        """Return the areas of the cells of a window, 0 elsewhere."""
        where = window.row, window.column, window.height, window.width
        risen, fallen = (painted(*runs, where) for runs in self._runs)
        return np.asarray(np.where(fallen > 0, fallen + self._risen, risen))

    def add(self, window: Window) -> np.ndarray:
        """Return the bands of a strip, ``(5, rows, columns)``."""
        found, labels = self._pair.read(window), self.labels(window)
        of_cells = 1.0, found.height, (found.down + found.up) / 2, *found.slopes
        for sums, values in zip(self._sums, of_cells, strict=True):
            sums += np.bincount(labels.ravel(), np.where(labels > 0, values, 0.0).ravel(), sums.size)
        bands = self._pair.bands(found)
        change = np.where(labels > self._risen, -1.0, np.minimum(labels, 1.0))
        return np.concatenate([bands, np.where(np.isfinite(bands[3]), change, np.nan)[np.newaxis]])

    def outlines(self) -> Iterator[Polygon]:
        """Yield the polygons of all areas."""
        for (start, stop, area, row_start), before in zip(self._runs, (0, self._risen), strict=True):
            rows = np.repeat(np.arange(row_start.size - 1), np.diff(row_start))
            order = np.argsort(area, kind="stable")
            for number, own in enumerate(
                np.split(order, np.searchsorted(area[order], np.arange(1, area.max(initial=0) + 1)))[1:], 1
            ):
                first = int(rows[own].min()), int(start[own].min())
                window = Window.around(first, (rows[own].max() + 1, stop[own].max()))
                yield outline(self.labels(window) == before + number, self._pair.before.place.shifted(window))

    @property
    def _common(self) -> np.ndarray:
        """Return errors of mean differences by the shift, which all areas share: ``(3, areas)`` with their signs."""
        cells, *_, east, north = self._sums[:, 1:]
        means = np.stack([east / cells, north / cells, np.ones_like(cells)])
        return np.asarray(self._pair.shift[1, :, np.newaxis] * means)

    def figures(self) -> dict[str, np.ndarray]:
        """Return of all areas sign, area, mean difference and its bounds, volume and its standard deviation."""
        cells, differences, deviations = self._sums[:3, 1:]
        correlation, area, mean = self._pair.correlation, cells * self._cell, differences / cells
        shares = np.array([correlation.within(one) for one in area])
        own = deviations / cells * np.sqrt(correlation.variance * shares)
        deviation = np.sqrt(own**2 + (self._common**2).sum(axis=0))
        half = self._pair.before.deviations * deviation
        return {
            "change": np.where(np.arange(area.size) < self._risen, 1, -1), "area": area,
            "difference": mean, "difference_lower": mean - half, "difference_upper": mean + half,
            "volume": area * mean, "volume_deviation": area * deviation,
        }  # fmt: skip

    def report(self, figures: dict[str, np.ndarray]) -> dict[str, Any]:
        """Return numbers of areas and their cells, and volumes with standard deviations."""
        risen, volume, common = figures["change"] > 0, {}, figures["area"] * self._common
        for name, chosen in (("gained", risen), ("lost", ~risen), ("net", risen | ~risen)):
            shared = common[:, chosen]
            own = (figures["volume_deviation"][chosen] ** 2).sum() - (shared**2).sum()
            variance = own + (shared.sum(axis=1) ** 2).sum()
            volume[name] = [float(figures["volume"][chosen].sum()), float(np.sqrt(max(variance, 0.0)))]
        cells = {name: int(self._sums[0, 1:][one].sum()) for name, one in (("risen", risen), ("fallen", ~risen))}
        return {"areas": risen.size, "cells": cells, "volume": volume}
