"""Gather the pixels of the page: histograms over all of them, and every n-th row and column."""

import base64
import gzip
import math
from collections import defaultdict
from typing import Any

import numpy as np

from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.products import Bands
from sat_intervals.results import Results
from sat_intervals.show.legend import classes_of, classify, limits
from sat_intervals.show.relief import relief

_PIXELS = 500_000  # on the page, 5 to 8 bytes each when compressed and encoded
_WIDTH_BARS, _CONFIDENCE_BARS = 60, 25
_STEPS = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # bar widths of the histogram of interval widths, px
_FINEST = {"px": 1 / 64, "m": 1 / 256}  # of disparities, of heights
_WIDE = 30  # metres, the last bar of widths of height intervals


class Histograms:
    """Histograms of interval width and confidence over all pixels, gathered strip by strip."""

    def __init__(self, results: Results) -> None:
        """Start with empty histograms; widths are up to the search range, or to _WIDE metres."""
        count = _WIDE if results.is_sweep else results.config.disparity.count
        self._step = next(step for step in _STEPS if count / step <= _WIDTH_BARS or step == _STEPS[-1])
        self._width_bars = math.ceil(count / self._step)
        self._counts: dict[str, Any] = defaultdict(int)

    def add(self, bands: Bands, low: np.ndarray) -> None:
        """Count the pixels of some rows; ``low`` is the mask of low confidence."""
        valid = bands.valid
        width, confidence = (bands.upper - bands.lower) / self._step, bands.confidence * _CONFIDENCE_BARS
        self._counts["high"] += _counted(width[valid & ~low], self._width_bars)
        self._counts["low"] += _counted(width[valid & low], self._width_bars)
        self._counts["valid"] += _counted(confidence[valid], _CONFIDENCE_BARS)
        self._counts["rejected"] += _counted(confidence[~valid], _CONFIDENCE_BARS)

    def report(self) -> dict[str, Any]:
        """Return counts per bar of ``step``; the last bar includes all values beyond."""
        counts = {name: bars.tolist() for name, bars in self._counts.items()}
        confidences = {name: counts[name] for name in ("valid", "rejected")}
        return {
            "width": {"step": self._step, "bars": {name: counts[name] for name in ("high", "low")}},
            "confidence": {"step": 1 / _CONFIDENCE_BARS, "bars": confidences},
        }


def _counted(places: np.ndarray, bars: int) -> np.ndarray:
    known = places[np.isfinite(places)]
    return np.bincount(np.clip(known, 0, bars - 1).astype(np.int64), minlength=bars)


class Pixels:
    """Every n-th row and column of a run, encoded for the page."""

    def __init__(self, results: Results) -> None:
        height, width = results.shape
        self._step = max(1, math.ceil(math.sqrt(height * width / _PIXELS)))
        self._results = results
        self._strips: list[list[np.ndarray]] = []

    def add(self, row: int, bands: Bands, low: np.ndarray) -> None:
        """Keep every n-th of the rows from ``row`` on; ``low`` is the mask of low confidence."""
        chosen = np.s_[-row % self._step :: self._step, :: self._step]
        self._strips.append([band[chosen].copy() for band in (*bands, low)])

    def report(self) -> dict[str, Any]:
        """Return layers of codes: a code means ``first + code * step``, the largest one a missing value."""
        *values, low = (np.concatenate(strips) for strips in zip(*self._strips, strict=True))
        bands = Bands(*values)
        kind, valid = classify(bands.validity), bands.valid
        missed = np.where(bands.truth > bands.upper, 1, np.where(bands.truth < bands.lower, 2, 0))
        disparities = {name: np.where(valid, getattr(bands, name), np.nan) for name in ("disparity", "lower", "upper")}
        if np.isfinite(bands.truth).any():
            disparities["truth"] = bands.truth
        # Leave room for a truth outside the search range: its extent once more on either side.
        search, image = self._results.quantity, bands.image
        extent = search.maximum - search.minimum + search.step
        first, step = search.minimum - extent, max(_FINEST[search.unit], 3 * extent / 65534)
        if self._results.is_sweep:
            across, down = (self._step * side for side in self._results.georeferencing.pixel_size)
            image = relief(disparities["disparity"].astype(np.float64), across, down)
        black, white = limits(image)
        layers = {name: _coded(values, first, step, "<u2") for name, values in disparities.items()}
        if local := self._results.report.get("local_ranges"):
            minimum, maximum = LocalRanges.of_report(local).at(self._results.region, self._step)
            layers["searched"] = _coded((maximum - minimum + 1.0) * search.step, 0, search.step, "<u2")
        return {
            "step": self._step,
            "rows": kind.shape[0],
            "columns": kind.shape[1],
            "layers": {
                **layers,
                "image": _coded(image, black, (white - black) / 254, "u1"),
                "confidence": _coded(bands.confidence, 0, 1 / 250, "u1"),
                "kind": _coded(kind, 0, 1, "u1"),
                "low": _coded(low, 0, 1, "u1"),
                "missed": _coded(np.where(valid, missed, 0), 0, 1, "u1"),
            },
            "kinds": [{"colour": each.colour, "meaning": each.meaning} for each in classes_of(self._results.report)],
        }


def _coded(values: np.ndarray, first: float, step: float, dtype: str) -> dict[str, Any]:
    unknown = np.iinfo(dtype).max
    codes = np.clip(np.rint((values - first) / step), 0, unknown - 1)
    packed = gzip.compress(np.where(np.isnan(codes), unknown, codes).astype(dtype).tobytes(), 9, mtime=0)
    text = base64.b64encode(packed).decode()
    return {"first": first, "step": step, "bits": 8 * np.dtype(dtype).itemsize, "codes": text}
