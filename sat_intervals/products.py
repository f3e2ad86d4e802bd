"""Define the data dictionary: bands, validity flags and the states of an input pixel."""

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from os import PathLike, fspath
from typing import Any, NamedTuple

import numpy as np

# State of an input pixel, and of a census window (the union of its pixels' states). 0 = usable.
NO_DATA = 1  # outside the image, declared no data, or not finite
MASKED = 2  # excluded by the user's mask

# Raw products of a tile hold integer disparities; this value marks a missing one.
NO_DISPARITY = -32768
# Their bounds are steps above the first disparity of the search range; this value marks a missing one.
NO_BOUND = 65535
# The aggregated cost of an impossible candidate, above every declared span.
IMPOSSIBLE_COST = 65535

# Sub-pixel bounds are multiples of 1 / 64 px, in files and, above the first disparity, in tiles.
BOUND_STEPS = 64

# The costs of probabilities are -ln(p / largest p of the pixel), at most this, divided by it.
LOG_SPAN = 32

# MC-CNN's matching cost is 1 - cosine in steps of 1 / 125 = 0.008. Its codes, 0 to 250, fit in a byte.
COSINE_STEPS = 125


@dataclass(frozen=True)
class Flag:
    """One bit of the validity band: its number, name and meaning, and whether it makes a pixel invalid."""

    bit: int
    name: str
    meaning: str
    invalid: bool

    @property
    def value(self) -> int:
        """Return ``1 << bit``."""
        return 1 << self.bit


# Validity bits (METHOD.md, section 9). To 12 they have Pandora's numbers, so its tools read our files.
FLAGS = (
    Flag(0, "left_window", "the left window meets the image's border, no data or a mask", True),
    Flag(1, "no_candidate", "all candidates impossible: outside the right image or on its no data", True),
    Flag(2, "range_incomplete", "part of the search range could not be searched", False),
    Flag(3, "not_refined", "disparity without sub-pixel refinement", False),
    Flag(6, "left_masked", "the left pixel is masked", True),
    Flag(7, "right_masked", "all candidates impossible, at least one through the right mask", True),
    Flag(8, "occlusion", "rejected by cross-checking: occlusion", True),
    Flag(9, "mismatch", "rejected by cross-checking: mismatch", True),
    Flag(11, "regularized", "low confidence; interval regularised, unless the calibration has no quantile", False),
    Flag(13, "range_end", "best candidate at an end of the search range, or next to it", False),
    Flag(14, "open_below", "interval open below: the disparity may be below the search range", False),
    Flag(15, "open_above", "interval open above: the disparity may be above the search range", False),
)
(
    LEFT_WINDOW, NO_CANDIDATE, RANGE_INCOMPLETE, NOT_REFINED, LEFT_MASKED, RIGHT_MASKED, OCCLUSION, MISMATCH,
    REGULARIZED, RANGE_END, OPEN_BELOW, OPEN_ABOVE,
) = (flag.value for flag in FLAGS)  # fmt: skip
REJECTED = OCCLUSION | MISMATCH
INVALID = sum(flag.value for flag in FLAGS if flag.invalid)

# Where many images are compared at heights, some have another meaning.
_MEANINGS_OF_SWEEP = {
    LEFT_WINDOW: "fewer than two images see the cell",
    NO_CANDIDATE: "no height could be compared",
    RANGE_INCOMPLETE: "part of the heights could not be compared",
    NOT_REFINED: "height without refinement between steps",
    **dict.fromkeys((LEFT_MASKED, RIGHT_MASKED, OCCLUSION), "not used: of pairs only"),
    RANGE_END: "best height at an end of those searched, or next to it",
    OPEN_BELOW: "interval open below: the height may be below those searched",
    OPEN_ABOVE: "interval open above: the height may be above those searched",
    MISMATCH: "at an end of the heights searched around it, or of the lowest confidence",
}
FLAGS_OF_SWEEP = tuple(replace(flag, meaning=_MEANINGS_OF_SWEEP.get(flag.value, flag.meaning)) for flag in FLAGS)


def flag_attributes() -> dict[str, object]:
    """Return attributes that describe the validity flags by the CF conventions."""
    return {
        "long_name": "validity flags",
        "flag_masks": np.array([flag.value for flag in FLAGS], np.uint16),
        "flag_meanings": " ".join(flag.name for flag in FLAGS),
    }


def cause(validity: np.ndarray) -> np.ndarray:
    """Return the flag that makes each pixel invalid, 0 if valid; of several, the first in the order of FLAGS."""
    reasons = validity.astype(np.int64) & INVALID
    return reasons & -reasons  # the lowest bit


WIDTH = "width of the disparity interval"


@dataclass(frozen=True)
class Band:
    """One band of a file: name (the GeoTIFF description), unit ("" for none, "1" beside metres) and meaning."""

    name: str
    unit: str
    meaning: str


BANDS = (
    Band("disparity", "px", "disparity of the left image, x_right = x_left + disparity"),
    Band("lower", "px", "lower bound of the disparity interval"),
    Band("upper", "px", "upper bound of the disparity interval"),
    Band("confidence", "", "confidence from ambiguity, 0 to 1, high = unambiguous"),
)

_EXTRA = (
    Band("sigma", "px", "standard deviation of the least-squares fit of the disparity, no data without one"),
    Band("agreement", "", "1 where the disparity that was given is in the interval, 0 where not; no data without both"),
)


def interval_bands(extra: Collection[str] = ()) -> tuple[Band, ...]:
    """Return the bands of a run, with those of ``sigma`` and ``agreement`` that are asked for."""
    return *BANDS, *(band for band in _EXTRA if band.name in extra)


class Bands(NamedTuple):
    """Results of a run for some pixels, with truth and left image where they were read; all ``(rows, columns)``."""

    disparity: np.ndarray  # float32 pixels, NaN if missing
    lower: np.ndarray  # the same
    upper: np.ndarray  # the same
    confidence: np.ndarray  # float32, 0 to 1, NaN if missing
    validity: np.ndarray  # uint16 flags
    truth: np.ndarray = np.empty((0, 0))  # true disparity in pixels, floats, NaN where unknown; empty if not read
    image: np.ndarray = np.empty((0, 0))  # grey values of the left image, floats, NaN where no data; empty if not read
    sigma: np.ndarray = np.empty((0, 0))  # float32 pixels, NaN without a fit; empty if not asked for
    agreement: np.ndarray = np.empty((0, 0))  # float32, 1, 0 or NaN; empty if not asked for

    @property
    def valid(self) -> np.ndarray:
        """Return the mask of pixels that were matched and passed cross-checking."""
        return np.asarray(self.validity & INVALID == 0)

    @property
    def matched(self) -> np.ndarray:
        """Return the disparities of valid pixels, NaN elsewhere."""
        return np.where(self.valid, self.disparity, np.float32(np.nan))

    @property
    def known(self) -> np.ndarray:
        """Return the mask of pixels with an interval and a truth."""
        return np.asarray(np.isfinite(self.truth) & np.isfinite(self.lower))


# Bands of points.tif: degrees, and metres above the WGS 84 ellipsoid (EPSG:4979).
POINTS = (
    Band("longitude", "degree", "of the point that the disparity gives, WGS 84 (EPSG:4979)"),
    Band("latitude", "degree", "of the same point"),
    Band("height", "m", "of the same point above the ellipsoid of WGS 84"),
    Band("height_lower", "m", "the lower of the heights that the two bounds of the disparity give"),
    Band("height_upper", "m", "the upper of them"),
    Band("residual", "m", "distance of the point from either line of sight: shows if the models fit, not the match"),
    Band("longitude_lower", "degree", "of the point at height_lower, which lies on the same left line of sight"),
    Band("latitude_lower", "degree", "of the point at height_lower"),
    Band("longitude_upper", "degree", "of the point at height_upper"),
    Band("latitude_upper", "degree", "of the point at height_upper"),
)

# The band of true disparities made from reference heights.
TRUTH = (Band("disparity", "px", "of the reference height that the left sensor sees at the pixel's centre"),)

# Bands of the local search ranges of a pair.
RANGES = (
    Band("minimum", "px", "first disparity that is searched for the pixel"),
    Band("maximum", "px", "last disparity that is searched for the pixel"),
)

# Bands of a surface model.
SURFACE = (
    Band("height", "m", "mean of the points that reach the cell, the nearer the heavier"),
    Band("height_lower", "m", "lower bound of the height"),
    Band("height_upper", "m", "upper bound of the height"),
    Band("count", "1", "points that reach the cell; 0 where it was filled or flattened"),
    Band("confidence", "1", "mean of their confidences, 0 to 1, high = easy to match"),
    Band("agreement", "1", "1 where the intervals of several pairs meet, 0 where they do not; no data for one pair"),
)

# The ortho-image beside a surface model.
ORTHO = "ortho.tif"

# Bands of the change of height between two surfaces.
CHANGE = (
    Band("difference", "m", "height after - height before"),
    Band("difference_lower", "m", "lower bound of the difference"),
    Band("difference_upper", "m", "upper bound of the difference"),
    Band("significance", "1", "probability of a difference as large, or larger, without a change"),
    Band("change", "1", "1 risen, -1 fallen, 0 neither, or in an area that is too small"),
)

# The same of many images that were compared at heights.
_OF_SWEEP = {
    "height": "height at which the images are most alike",
    "count": "images that see the cell; 0 where it was filled or flattened",
    "confidence": BANDS[3].meaning,
    "agreement": "no data",
}
SURFACE_OF_SWEEP = tuple(replace(band, meaning=_OF_SWEEP.get(band.name, band.meaning)) for band in SURFACE)


def plain(content: Any) -> Any:
    """Return a record as JSON gives it back: numbers are Python's, NaN and infinity are None."""
    if isinstance(content, Mapping):
        return {str(key): plain(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [plain(value) for value in content]
    if isinstance(content, np.generic):
        content = content.item()
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return fspath(content) if isinstance(content, PathLike) else content


def as_json(content: Any, *, indent: int | None = 1) -> str:
    """Return a record as JSON; every record that is written goes through here."""
    return json.dumps(plain(content), indent=indent)
