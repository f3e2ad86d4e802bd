"""Local search ranges that files give: a raster of ranges, or the disparities of another matcher."""

from pathlib import Path

import numpy as np

from sat_intervals.config import Config, Disparity
from sat_intervals.config.sections import MOST_PIXELS
from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.around import CELL, ranges_around
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.products import RANGES
from sat_intervals.raster import Image, Layer, OutputWriter, open_image, ranges_file, read_shape, read_window
from sat_intervals.raster.identity import identity
from sat_intervals.raster.images import check_size
from sat_intervals.raster.layers import tag_of_left, tags_beside
from sat_intervals.tiling import Window

# Rows that are written at a time.
_STRIP = 256


def given_ranges(search: Disparity, left: Image) -> tuple[LocalRanges, str] | None:
    """Return the local ranges that settings give by a file, and which file; None if they give none."""
    if search.grid:
        tags_beside(search.grid, identity(left.path))
        return read_ranges(search.grid, left), search.grid
    if search.around:
        return _ranges_around(search.around, left, search.margin), search.around
    return None


def _ranges_around(path: str, left: Image, margin: int) -> LocalRanges:
    """Read the disparities of another matcher, and return the ranges around them."""
    raster = open_image(path, band=1)
    check_size(path, (raster.height, raster.width), left, "give the disparity of each pixel of the left image")
    _check_grid(raster, left)
    windows = (Window(row, 0, min(CELL, left.height - row), left.width) for row in range(0, left.height, CELL))
    return ranges_around((Layer(raster, 0, 0).read(window) for window in windows), margin)


def given_disparities(config: Config, window: Window) -> np.ndarray | None:
    """Read the disparities of another matcher in a window of the left image, NaN for none; None if none are given."""
    path = config.disparity.around
    return Layer(open_image(path, band=1), 0, 0).read(window) if path else None


def write_ranges(path: Path, ranges: LocalRanges, left: Image) -> None:
    """Write local ranges as `read_ranges` reads them: minimum and maximum of each pixel of the left image."""
    shape, tags = (left.height, left.width), tag_of_left(identity(left.path))
    tags |= {"RANGES_OF": left.path, "SOFTWARE": "sat-intervals"}
    with OutputWriter(path.parent, [ranges_file(path.name)], *shape, left.georeferencing, tags) as writer:
        for row in range(0, left.height, _STRIP):
            window = Window(row, 0, min(_STRIP, left.height - row), left.width)
            writer.write(row, np.stack(ranges.at(window)))
        writer.publish()


def read_ranges(path: str, left: Image) -> LocalRanges:
    """Read a raster of minimum and maximum of each pixel of the left image; reduce it to cells, rounded outwards."""
    bands, height, width = read_shape(path)
    if (bands, height, width) != (len(RANGES), left.height, left.width):
        raise SatIntervalsError(
            f"{path} has {bands} bands of {height} x {width} pixels, {left.path} {left.height} x {left.width}: give "
            "minimum and maximum for each pixel of the left image"
        )
    images = [open_image(path, band=band) for band in (1, 2)]
    _check_grid(images[0], left)
    rows = [_row_of_cells(images, Window(row, 0, min(CELL, height - row), width)) for row in range(0, height, CELL)]
    minimum, maximum = (np.stack(bound) for bound in zip(*rows, strict=True))
    return LocalRanges(minimum, maximum, CELL, CELL)


def _check_grid(raster: Image, left: Image) -> None:
    here, there = raster.georeferencing, left.georeferencing
    if here.crs and there.crs and (here.crs, here.transform) != (there.crs, there.transform):
        raise SatIntervalsError(
            f"{raster.path} and {left.path} have different georeferencing: give a raster on the grid of the left image"
        )


def _row_of_cells(images: list[Image], window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Minima and maxima of the cells of some rows, int16."""
    (low, no_low), (high, no_high) = (read_window(image, window) for image in images)
    empty = (no_low | no_high) != 0
    if (wrong := ~empty & (low > high)).any():
        row, column = (int(place[0]) for place in np.nonzero(wrong))
        raise SatIntervalsError(
            f"{images[0].path} has minimum {low[row, column]:g} above maximum {high[row, column]:g} at row "
            f"{window.row + row}, column {column}: swap the bands"
        )
    starts = np.arange(0, window.width, CELL)
    least = np.minimum.reduceat(np.floor(low).min(axis=0), starts)
    most = np.maximum.reduceat(np.ceil(high).max(axis=0), starts)
    has_gap = np.logical_or.reduceat(empty.any(axis=0), starts)
    ends = np.clip(np.where(has_gap, [[1], [0]], [least, most]), -MOST_PIXELS, MOST_PIXELS).astype(np.int16)
    return ends[0], ends[1]
