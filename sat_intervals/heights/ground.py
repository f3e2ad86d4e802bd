"""Find the heights of the ground of a raw pair: match both images, reduced, over all heights of their models."""

import logging
import math
from collections.abc import Sequence
from itertools import product

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.epipolar import MARGIN, STEP, shareloc_grids
from sat_intervals.heights.models import SensorImage, common_heights, common_parts
from sat_intervals.kernels.resampling import Step
from sat_intervals.match.coarse import match_level
from sat_intervals.raster import read_reduced
from sat_intervals.tiling import Window

try:
    from scipy.ndimage import map_coordinates
except ModuleNotFoundError as error:
    raise SatIntervalsError("sensor models need shareloc: pip install 'sat-intervals[dsm]'") from error

# Side of the reduced images at most, and at least that of the smaller one, in pixels; reduction at least: rows of
# models are off by some pixels.
_SIDE, _LEAST, _REDUCTION = 512, 64, 2
# Pixels of a surface at least, and share of the pixels of the smaller image that are matched: see `search_range`.
_SPECKLE, _FEWEST = 60, 0.2
# Share of matches, stray ones among them, beyond the range at each end, and its half with a margin for them.
_BEYOND, _HALF = 0.02, 0.6
_AS_GOOD = 0.8  # share of the matches of the best reading of the tags from which another one fits

_LOG = logging.getLogger(__name__)


def read_with_ground(
    lefts: Sequence[SensorImage], rights: Sequence[SensorImage], *, is_needed: bool
) -> tuple[SensorImage, SensorImage, tuple[float, int] | None]:
    """Return the readings of both images whose rows fit, and their ground, see `ground_of`, if it is needed."""
    pairs = list(product(lefts, rights))
    if len(pairs) == 1 and not is_needed:
        return *pairs[0], None
    grounds, shares = zip(*(ground_of(*pair) for pair in pairs), strict=True)
    fits = np.array(shares) >= _AS_GOOD * max(shares)
    chosen = int(fits.argmax())
    for side, one in enumerate(pairs[chosen]):
        origins = dict.fromkeys(pair[side].origin for pair, is_fit in zip(pairs, fits, strict=True) if is_fit)
        if others := [origin for origin in origins if origin != one.origin]:
            _LOG.warning(
                "%s: its RPC tags are taken for an image where it begins at row %g, column %g; row %g, column %g fits "
                "as well: if that is right, give the image that they are for as its model",
                *(one.image.path, *one.origin, *others[0]),
            )
    return *pairs[chosen], grounds[chosen] if is_needed else None


def ground_of(left: SensorImage, right: SensorImage) -> tuple[tuple[float, int] | None, float]:
    """Return middle (metres) and reach (pixels) of the ground, None if unknown; and the share of pixels that match."""
    heights = common_heights(left, right)
    shares, parts = common_parts(left, right, heights, 0)
    if parts is None:
        return None, 0.0
    lowest, highest = heights[np.flatnonzero(shares)[[0, -1]]]
    sides = [side for part in parts for side in (part.height, part.width)]
    step = max(_REDUCTION, min(max(sides) // _SIDE, min(sides) // _LEAST))
    middle = float(lowest + highest) / 2
    nodes, shape, base = shareloc_grids((left, right), parts, middle, step)
    most = (highest - lowest) / 2 * base / step
    if not most > 1:  # the height hardly matters
        return None, 0.0
    images = [_epipolar(*one, shape, step) for one in zip((left, right), parts, nodes, strict=True)]
    found = match_level(images[0], images[1], (-math.ceil(most), math.ceil(most)), _SPECKLE)
    matched = found.kept.sum() / max(1, min(np.isfinite(image).sum() for image in images))
    if matched < _FEWEST:
        return None, float(matched)
    low, high = np.quantile(found.disparity[found.kept], [_BEYOND, 1 - _BEYOND])
    height = round(float(middle - (low + high) / 2 * step / base))
    return (height, math.ceil(_HALF * (high - low) * step)), float(matched)


def _epipolar(of: SensorImage, part: Window, nodes: np.ndarray, shape: tuple[int, int], step: int) -> np.ndarray:
    """Return the reduced epipolar image of a part of an image, float32, NaN where not usable."""
    small = read_reduced(of.image, part, Step(step, step))
    at = np.indices(shape) / STEP + MARGIN
    first = of.origin[0] + part.row, of.origin[1] + part.column
    places = [(map_coordinates(nodes[..., i], at, order=1) - first[i]) / step - 0.5 for i in (0, 1)]
    return np.asarray(map_coordinates(small, places, order=1, cval=np.nan))
