"""Areas of change: connected cells of one sign, their mean differences and volumes, with standard deviations.

An area has enough cells that are significant at the named rate; cells beside them that are likely to have changed
belong to it, too.
"""

from typing import Any

import numpy as np

from sat_intervals.evaluate.change import Pair
from sat_intervals.kernels.components import components
from sat_intervals.kernels.significance import ratio_of
from sat_intervals.raster.polygons import Areas, numbers_of
from sat_intervals.tiling import Window

# Probability without a change up to which cells beside an area belong to it: half as many cells again of blocks of 7 to
# 10 m, and on unchanged ground at most .008 of the cells in areas at a rate of .01, as many areas as without.
_LIKELY = 0.2


def signs_of(pair: Pair, false_alarms: float, stable: Areas | None) -> tuple[np.ndarray, dict[str, int]]:
    """Find the cells that changed at a rate of false alarms: 2 risen, 1 likely, 0, -1, -2 fallen, a byte each.

    Returns numbers of cells, too: ``compared``, of these on ``stable`` ground, and of these ``false``.
    """
    signs, counts = np.zeros(pair.before.shape, np.int8), np.zeros(3, np.int64)
    limit, likely = (ratio_of(rate, pair.scale) for rate in (false_alarms, max(false_alarms, _LIKELY)))
    for window in pair.strips():
        ratio = pair.read(window).ratio
        known, found = np.isfinite(ratio), np.abs(ratio) >= limit
        signs[window.slices] = np.sign(np.nan_to_num(ratio)) * (found * 1 + (np.abs(ratio) >= likely))
        checked = known & (numbers_of(stable, pair.before.place, window) > 0)
        counts += known.sum(), checked.sum(), (checked & found).sum()
    return signs, dict(zip(("compared", "stable", "false"), counts.tolist(), strict=True))


class ChangedAreas:
    """The areas of a pair; ``labels``: their numbers at cells, from 1, those that rose first. `add` strips first."""

    def __init__(self, pair: Pair, signs: np.ndarray, smallest: float) -> None:
        """``smallest`` area is in square metres."""
        self._pair = pair
        self._cell = float(np.prod(pair.before.place.pixel_size))
        least = int(np.clip(np.ceil(smallest / self._cell - 1e-9), 1, signs.size + 1))
        self.labels = components(signs, signs != 0)
        sure = np.zeros(int(self.labels.max(initial=0)) + 1, np.int64)  # significant cells, negative of fallen areas
        for window in pair.strips():
            np.add.at(sure, self.labels[window.slices], (signs[window.slices] / 2).astype(np.int64))
        risen, fallen = np.flatnonzero(sure >= least), np.flatnonzero(-sure >= least)
        numbers = np.zeros(sure.size, np.int32)
        numbers[[*risen, *fallen]] = 1 + np.arange(risen.size + fallen.size)
        for window in pair.strips():
            self.labels[window.slices] = numbers[self.labels[window.slices]]
        self._is_risen = np.arange(risen.size + fallen.size) < risen.size
        # cells, differences, deviations, slopes to the east and to the north
        self._sums = np.zeros((5, 1 + self._is_risen.size))

    def add(self, window: Window) -> np.ndarray:
        """Return the bands of a strip, ``(5, rows, columns)``."""
        found, labels = self._pair.read(window), self.labels[window.slices]
        of_cells = 1.0, found.height, (found.down + found.up) / 2, *found.slopes
        for sums, values in zip(self._sums, of_cells, strict=True):
            sums += np.bincount(labels.ravel(), np.where(labels > 0, values, 0.0).ravel(), sums.size)
        bands = self._pair.bands(found)
        change = np.where(labels > self._is_risen.sum(), -1.0, np.minimum(labels, 1.0))
        return np.concatenate([bands, np.where(np.isfinite(bands[3]), change, np.nan)[np.newaxis]])

    def report(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return sign, area, mean difference, volume and their errors of all areas; numbers, and volumes together."""
        cells, differences, deviations, east, north = self._sums[:, 1:]
        correlation, area, mean = self._pair.correlation, cells * self._cell, differences / cells
        # errors of mean differences by the shift, which all areas share, with their signs
        common = self._pair.shift[1, :, np.newaxis] * np.stack([east / cells, north / cells, np.ones_like(cells)])
        shares = np.array([correlation.within(one) for one in area])
        own = deviations / cells * np.sqrt(correlation.variance * shares)
        deviation = np.sqrt(own**2 + (common**2).sum(axis=0))
        half, risen = self._pair.before.deviations * deviation, self._is_risen
        figures = {
            "change": np.where(risen, 1, -1), "area": area, "difference": mean, "difference_lower": mean - half,
            "difference_upper": mean + half, "volume": area * mean, "volume_deviation": area * deviation,
        }  # fmt: skip
        volume, counted = {}, {"risen": int(cells[risen].sum()), "fallen": int(cells[~risen].sum())}
        for name, chosen in (("gained", risen), ("lost", ~risen), ("net", risen | ~risen)):
            variance = ((area * own)[chosen] ** 2).sum() + ((area * common)[:, chosen].sum(axis=1) ** 2).sum()
            volume[name] = [float(figures["volume"][chosen].sum()), float(np.sqrt(variance))]
        return figures, {"areas": risen.size, "cells": counted, "volume": volume}
