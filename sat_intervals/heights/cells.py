"""Make the cells of a surface model, each tile of some rows from the points near it of all runs, and count them."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.point_cloud import Cells, PointCloud
from sat_intervals.kernels.conformal import AROUND, Margins, outwards, relief_of
from sat_intervals.kernels.gridding import BOUNDED, CONFIDENCE, COUNT, HEIGHT, LOWER, UPPER, WEIGHT
from sat_intervals.match.histogram import quantile
from sat_intervals.prepare.pair import Rows
from sat_intervals.products import SURFACE
from sat_intervals.tiling import Window, strips_of_windows

_TILE = 1024  # largest side of a tile in cells: some hundred megabytes
_LISTED = 1 << 24  # bounds listed for the quantiles of a tile: 4 bytes each
_STEPS, _WIDEST = 50, 1000  # widths are counted in steps of 2 cm, up to so many metres
# Share of the weights below the height of runs that are apart; cells between heights that are.
_LOW, _APART = 1 / 3, 2.0
_NARROWEST = 0.01  # metres: narrower intervals weigh as much as one of this width
WIDE = 20.0  # metres: half widths from this on are reported as a share

Tile = tuple[Window, list[PointCloud]]
"""A window of cells, and the points near it of each run."""


@dataclass(frozen=True)
class Gridding:
    """Points of runs, the cells that they fill, their reach in metres, and how."""

    clouds: Sequence[PointCloud]
    cells: Cells
    radius: float
    choices: SurfaceChoices

    def arguments(self, rows: Window) -> tuple[Any, ...]:
        """Return what `rows_of_cells` needs for some rows."""
        cells, margin = self.cells, AROUND if self.choices.calibration else 0
        around = rows.grown(margin, 0).clipped(Window(0, 0, cells.rows, cells.columns))
        near = [cloud.near(cells.extent(around).grown(self.radius)) for cloud in self.clouds]
        tiles = []
        for windows in strips_of_windows((around.height, around.width), *self._tile_size(around)):
            for window in (replace(one, row=around.row + one.row) for one in windows):
                extent = cells.extent(window).grown(self.radius)
                tiles.append((window, [cloud.near(extent) for cloud in near]))
        return rows, around, tiles, replace(self, clouds=())

    def _tile_size(self, around: Window) -> tuple[int, int]:
        """Return rows and columns of a tile: as large as memory allows, all of the same size."""
        rows, columns = min(around.height, _TILE), _TILE
        if self.choices.bounds == "quantiles":
            side = self.cells.resolution
            reaching = max(1.0, math.pi * (self.radius / side) ** 2)  # cells that a point reaches
            most = _LISTED / reaching * min(cloud.ground.pixel_area for cloud in self.clouds) / side**2
            rows = max(1, min(rows, int(math.sqrt(most))))
            columns = max(1, min(columns, int(most / rows)))
        # equal parts
        rows, columns = (
            -(-whole // -(-whole // most)) for whole, most in ((around.height, rows), (around.width, columns))
        )
        return rows, columns


def rows_of_cells(rows: Window, around: Window, tiles: Sequence[Tile], how: Gridding) -> Rows:
    """Return the bands of SURFACE of some rows, and what `counted` notes of them; runs on a worker.

    ``around``: the rows with those that their calibration needs, which ``tiles`` fill.
    """
    counts, choices = Counter[str](), how.choices
    bands = np.empty((len(SURFACE), around.height, around.width), np.float32)
    for window, clouds in tiles:
        gathered, found = zip(*(cloud.splat(how.cells, window, how.radius, rows) for cloud in clouds), strict=True)
        bands[:, *window.relative_to(around).slices] = fused(gathered, _APART * how.cells.resolution)
        counts = sum(found, counts)
    made = bands[:, *rows.relative_to(around).slices]
    measured = np.isfinite(made[0]).sum()
    remove_poor_cells(bands, None, choices.min_confidence)
    if choices.calibration:
        margins, relief = Margins(*choices.calibration.table()), relief_of(bands[0])
        for part in _parts(around.width):
            height, lower, upper = bands[:3, :, part]
            bands[1:3, :, part] = margins.widened(height, lower, upper, relief[:, part])
    remove_poor_cells(bands, choices.max_width, None)
    counts["poor_cells"] = int(measured - np.isfinite(made[0]).sum())
    return [made], counted(made, counts)


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


def remove_poor_cells(bands: np.ndarray, max_width: float | None, min_confidence: float | None) -> None:
    """Set the cells of wider intervals or lower confidence to NaN, in place."""
    height, lower, upper, _, confidence, _ = bands
    poor = np.zeros(height.shape, np.bool_)
    if max_width is not None:
        poor |= ~(upper - lower <= max_width)
    if min_confidence is not None:
        poor |= ~(confidence >= min_confidence)
    bands[:, poor] = np.nan


def counted(bands: np.ndarray, counts: Counter[str]) -> dict[str, Any]:
    """Return numbers of cells beside ``counts`` of their points, and numbers of their widths in steps."""
    counts, widths = Counter(counts), Counter[str]()
    for part in _parts(bands.shape[2]):
        height, lower, upper, *_, agreement = bands[:, :, part]
        width = upper - lower
        width = width[np.isfinite(width)]
        known = {"filled": np.isfinite(height), "shared": np.isfinite(agreement), "disagreeing": agreement == 0}
        known |= {"bounded": np.isfinite(width), "wide": width >= 2 * WIDE}
        counts.update({name: int(np.count_nonzero(of)) for name, of in known.items()})
        steps = np.bincount(np.clip(np.rint(width * _STEPS), 0, _WIDEST * _STEPS).astype(np.int64))
        found = np.flatnonzero(steps).tolist()
        widths.update(dict(zip(map(str, found), steps[found].tolist(), strict=True)))
    return {"counts": dict(counts), "widths": dict(widths)}


def _parts(width: int) -> list[slice]:
    """Return columns that are worked on at a time: memory beside the bands stays small."""
    return [slice(first, min(first + _TILE, width)) for first in range(0, width, _TILE)]


def report_of(noted: Iterable[Mapping[str, Any]], cells: int) -> dict[str, Any]:
    """Return the figures of a surface, see `make_surface`, with shares of so many cells, from those of `counted`."""
    counts, widths = Counter[str](), Counter[str]()
    for one in noted:
        counts.update(one["counts"])
        widths.update(one["widths"])
    steps = np.array([*map(int, widths)], np.int64)
    median = quantile(steps / _STEPS, np.array([*widths.values()], np.int64), 0.5)
    return {
        **{name: counts[name] for name in ("points", "outliers", "open", "border", "poor_cells")},
        "filled": counts["filled"] / cells,
        "disagreeing": counts["disagreeing"] / counts["shared"] if counts["shared"] else None,
        "median_half_width": median / 2 if widths else None,
        "wide": counts["wide"] / counts["bounded"] if widths else None,
    }
