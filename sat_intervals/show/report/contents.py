"""Gather the pixels of the page: histograms over all of them, and every n-th row and column."""

import base64
import gzip
import math
from typing import Any

import numpy as np

from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.products import Bands
from sat_intervals.results import Results
from sat_intervals.show.legend import FIRST_INVALID, PIXEL_CLASSES, classify

_PIXELS = 500_000  # on the page, 5 to 8 bytes each when compressed and encoded
_WIDTH_BARS, _CONFIDENCE_BARS = 60, 25
_STEPS = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # bar widths of the histogram of interval widths, px
_FINEST = 1 / 64  # pixels of disparity


class Counts:
    """Histograms of interval width, confidence and pixel class over all pixels, gathered strip by strip."""

    def __init__(self, count: int) -> None:
        """Start with empty histograms; ``count`` is the number of disparities searched."""
        self._step = next(step for step in _STEPS if count / step <= _WIDTH_BARS or step == _STEPS[-1])
        bars = math.ceil(count / self._step)
        self._widths = {name: np.zeros(bars, np.int64) for name in ("high", "low")}
        self._confidences = {name: np.zeros(_CONFIDENCE_BARS, np.int64) for name in ("valid", "rejected")}
        self._classes = np.zeros(len(PIXEL_CLASSES), np.int64)

    def add(self, bands: Bands, low: np.ndarray) -> None:
        """Count the pixels of some rows; ``low`` is the mask of low confidence."""
        classes = classify(bands.validity)
        self._classes += np.bincount(classes.ravel(), minlength=self._classes.size)
        valid = classes < FIRST_INVALID
        width = bands.upper - bands.lower
        measured = valid & np.isfinite(width)
        for name, chosen in (("high", measured & ~low), ("low", measured & low)):
            _count(width[chosen] / self._step, self._widths[name])
        known = np.isfinite(bands.confidence)
        for name, chosen in (("valid", known & valid), ("rejected", known & ~valid)):
            _count(bands.confidence[chosen] * _CONFIDENCE_BARS, self._confidences[name])

    def report(self) -> dict[str, Any]:
        """Return counts per pixel class and per bar of ``step``; the last bar includes all values beyond."""
        widths = {name: bars.tolist() for name, bars in self._widths.items()}
        confidences = {name: bars.tolist() for name, bars in self._confidences.items()}
        return {
            "width": {"step": self._step, "bars": widths},
            "confidence": {"step": 1 / _CONFIDENCE_BARS, "bars": confidences},
            "classes": self._classes.tolist(),
        }


def _count(places: np.ndarray, bars: np.ndarray) -> None:
    bars += np.bincount(np.clip(places, 0, bars.size - 1).astype(np.int64), minlength=bars.size)


class Pixels:
    """Every n-th row and column of a run, encoded for the page."""

    def __init__(self, results: Results) -> None:
        height, width = results.shape
        self._step = max(1, math.ceil(math.sqrt(height * width / _PIXELS)))
        self._search = results.config.disparity
        self._strips: list[list[np.ndarray]] = []
        self._region = results.region
        local = results.report.get("local_ranges")
        self._ranges = LocalRanges.of_report(local) if local else None

    def add(self, row: int, bands: Bands, low: np.ndarray) -> None:
        """Keep every n-th of the rows from ``row`` on; ``low`` is the mask of low confidence."""
        chosen = np.s_[-row % self._step :: self._step, :: self._step]
        self._strips.append([band[chosen].copy() for band in (*bands, low)])

    def report(self) -> dict[str, Any]:
        """Return layers of codes: a code means ``first + code * step``, the largest one a missing value."""
        *values, low = (np.concatenate(strips) for strips in zip(*self._strips, strict=True))
        bands = Bands(*values)
        kind = classify(bands.validity)
        valid = kind < FIRST_INVALID
        missed = np.where(bands.truth > bands.upper, 1, np.where(bands.truth < bands.lower, 2, 0))
        disparities = {name: np.where(valid, getattr(bands, name), np.nan) for name in ("disparity", "lower", "upper")}
        if np.isfinite(bands.truth).any():
            disparities["truth"] = bands.truth
        # Leave room for a truth outside the search range: its extent once more on either side.
        first = self._search.minimum - self._search.count
        step = max(_FINEST, 3 * self._search.count / 65534)
        black, white = _ends(bands.image)
        layers = {name: _coded(values, first, step, "<u2") for name, values in disparities.items()}
        if self._ranges:
            minimum, maximum = self._ranges.at(self._region, self._step)
            layers["searched"] = _coded(maximum - minimum + 1.0, 0, 1, "<u2")
        return {
            "step": self._step,
            "rows": kind.shape[0],
            "columns": kind.shape[1],
            "layers": {
                **layers,
                "image": _coded(bands.image, black, (white - black) / 254, "u1"),
                "confidence": _coded(bands.confidence, 0, 1 / 250, "u1"),
                "kind": _coded(kind, 0, 1, "u1"),
                "low": _coded(low, 0, 1, "u1"),
                "missed": _coded(np.where(valid, missed, 0), 0, 1, "u1"),
            },
            "kinds": [{"colour": each.colour, "meaning": each.meaning} for each in PIXEL_CLASSES],
        }


def _ends(image: np.ndarray) -> tuple[float, float]:
    """Return the grey values drawn as black and white, percentiles 1 and 99."""
    known = image[np.isfinite(image)]
    if known.size == 0:
        return 0.0, 1.0
    low, high = np.percentile(known, (1, 99))
    return float(low), float(high) if high > low else float(low) + 1.0


def _coded(values: np.ndarray, first: float, step: float, dtype: str) -> dict[str, Any]:
    unknown = np.iinfo(dtype).max
    codes = np.clip(np.rint((values - first) / step), 0, unknown - 1)
    packed = gzip.compress(np.where(np.isnan(codes), unknown, codes).astype(dtype).tobytes(), 9, mtime=0)
    text = base64.b64encode(packed).decode()
    return {"first": first, "step": step, "bits": 8 * np.dtype(dtype).itemsize, "codes": text}
