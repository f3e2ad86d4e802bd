"""Define the pixel classes of maps and reports, their colours, and the ends of colour scales."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.products import FLAGS, REGULARIZED, cause

# The palette of Okabe and Ito, safe for colour-blind readers.
BLUE, SKY, ORANGE, VERMILION, PURPLE = "#0072b2", "#56b4e9", "#e69f00", "#d55e00", "#cc79a7"

_INVALID = {
    "left_window": "#4d4d4d",
    "no_candidate": "#000000",
    "left_masked": PURPLE,
    "right_masked": BLUE,
    "occlusion": ORANGE,
    "mismatch": VERMILION,
}


class PixelClass(NamedTuple):
    """A class of pixels: colour (``#rrggbb``), meaning, and validity flag (0 = none)."""

    colour: str
    meaning: str
    flag: int


PIXEL_CLASSES = (
    PixelClass("#f2f2f2", "valid, high confidence", 0),
    PixelClass(SKY, "valid, low confidence", REGULARIZED),
    *(PixelClass(_INVALID[flag.name], flag.meaning, flag.value) for flag in FLAGS if flag.invalid),
)


def classes_of(report: Mapping[str, Any]) -> list[PixelClass]:
    """Return PIXEL_CLASSES with what their flags mean in a ``run.json``."""
    meanings = {1 << flag["bit"]: flag["meaning"] for flag in report["validity_bits"].values() if flag["invalid"]}
    return [kind._replace(meaning=meanings.get(kind.flag, kind.meaning)) for kind in PIXEL_CLASSES]


def classify(validity: np.ndarray) -> np.ndarray:
    """Return the index into PIXEL_CLASSES of each pixel of a validity band, uint8; see `products.cause`."""
    causes = cause(validity)
    places = np.where(validity & REGULARIZED, 1, 0).astype(np.uint8)
    for place, kind in enumerate(PIXEL_CLASSES[2:], start=2):
        places[causes == kind.flag] = place
    return places


def class_counts(counts: dict[str, Any]) -> list[int]:
    """Return the number of pixels in each of PIXEL_CLASSES from the section ``counts`` of ``run.json``."""
    regularized = counts["low_confidence"]
    return [counts["valid"] - regularized, regularized, *counts["causes"].values()]


def limits(values: np.ndarray, otherwise: tuple[float, float] = (0, 1), cut: float = 1) -> tuple[float, float]:
    """Return the finite values of which ``cut`` percent are below and above; ``otherwise`` if there are none."""
    known = values[np.isfinite(values)]
    if known.size == 0:
        return otherwise
    low, high = (float(end) for end in np.percentile(known, (cut, 100 - cut), method="nearest"))
    return (low, high) if low < high else (low - 0.5, high + 0.5)


def widest(widths: np.ndarray, cut: float, times: float = np.inf) -> float:
    """Return the finite width that ``cut`` percent exceed, at most so many medians; 1 if it is zero or without any."""
    known = widths[np.isfinite(widths)]
    most, middle = np.percentile(known, (100 - cut, 50), method="nearest").tolist() if known.size else (1.0, 1.0)
    return float(min(most, times * middle or most) or 1.0)
