"""Resample raw images to a surface: an ortho-image on its grid, without the cells that no image sees."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.point_cloud import Cells
from sat_intervals.heights.rectify import raw_inputs
from sat_intervals.kernels.resampling import resample
from sat_intervals.kernels.row_offsets import AFTER, BEFORE
from sat_intervals.machine import usable_cores
from sat_intervals.match.ground import GroundViews
from sat_intervals.products import ORTHO, Band
from sat_intervals.progress import Progress
from sat_intervals.raster import (
    File,
    Image,
    OutputWriter,
    Projection,
    read_layers,
    read_place,
    read_reduced_views,
    read_small_layers,
    read_tags,
)
from sat_intervals.results import Run, open_input
from sat_intervals.tiling import View, Window, strips_of_windows

# Rows of a strip, and columns of a window in it.
_ROWS, _COLUMNS = 128, 1024
_FEW = 1024  # rows and columns that are read for the range of heights


def write_orthos(
    surface: Path, images: Sequence[Image], ground: GroundViews, bands: Sequence[Band], progress: Progress
) -> None:
    """Write images, resampled to the surface, beside it: a band of each, or one of medians; replaces a file.

    ``ground``: where they show the cells of the surface.
    """
    from sat_intervals.heights.views import towards  # needs the extra `dsm`

    shape, place = read_place(surface)
    sights, ends = -towards(ground, place.pixel_size[0]) / place.pixel_size[0], _ends(surface, shape)
    reach = int(np.ceil(np.abs(sights).max() * (ends[1] - ends[0]))) + 1

    def tile(window: Window) -> np.ndarray:
        around = window.grown(reach, reach)
        inside = around.clipped(Window(0, 0, *shape))
        all_heights = np.full((around.height, around.width), np.float32(np.nan))
        all_heights[inside.relative_to(around).slices] = read_layers(surface, inside, band=1)
        heights = all_heights[window.relative_to(around).slices]
        known = np.isfinite(heights)
        if not known.any():
            return np.broadcast_to(heights, (len(bands), *heights.shape))
        disparity = (np.where(known, heights, np.median(heights[known])) - ground.base) / ground.step
        searched = int(np.floor(disparity.min())), int(np.ceil(disparity.max()))
        views = read_reduced_views(images, ground.windows(window, *searched), ground.reductions)
        found = np.stack([ortho(view, ground.positions(n, window, disparity)) for n, view in enumerate(views)])
        found[np.stack([hidden(all_heights, heights.shape, sight) for sight in sights])] = np.nan
        found = found if len(bands) == len(images) else median_of(found)[np.newaxis]
        return np.where(known, found, np.float32(np.nan)).astype(np.float32)

    tags = {"SOFTWARE": "sat-intervals", "RUNS": read_tags(surface).get("RUNS", "")}
    file = File(ORTHO, "float32", float("nan"), tuple(bands))
    with (
        OutputWriter(surface.parent, [file], *shape, place, tags) as writer,
        ThreadPoolExecutor(usable_cores()) as threads,
    ):
        for windows in strips_of_windows(shape, _ROWS, _COLUMNS):
            progress("ortho", windows[0].row, shape[0])
            writer.write(windows[0].row, np.concatenate([*threads.map(tile, windows)], axis=2))
        writer.publish()
        progress("ortho", shape[0], shape[0])


def _ends(surface: Path, shape: tuple[int, int]) -> tuple[float, float]:
    """Return the lowest and the highest of some heights of a surface; raise if it has none."""
    known = read_small_layers(surface, (min(shape[0], _FEW), min(shape[1], _FEW)))[0]
    if not np.isfinite(known).any():
        raise SatIntervalsError(f"{surface} has no heights: leave out ortho")
    return float(np.nanmin(known)), float(np.nanmax(known))


def ortho(view: View, places: np.ndarray) -> np.ndarray:
    """Return an image resampled to positions of cells, ``(rows, columns, 2)``, see `GroundViews.positions`."""
    nodes = np.pad(places, ((0, 1), (0, 1), (0, 0)), mode="edge")
    around = Window.around(places.min(axis=(0, 1)) - BEFORE, places.max(axis=(0, 1)) + AFTER + 1)
    pixels = np.full((around.height, around.width), np.float32(np.nan))
    inside = around.clipped(view.window)
    if inside.height and inside.width:
        pixels[inside.relative_to(around).slices] = view.pixels[inside.relative_to(view.window).slices]
    return np.asarray(resample(pixels, (around.row, around.column), nodes, 1, (0, 0), *places.shape[:2]))


def median_of(values: np.ndarray) -> np.ndarray:
    """Return the median along the first axis, without NaN; much faster than `numpy.nanmedian`."""
    ordered, count = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1)
    return np.asarray(np.take_along_axis(ordered, np.stack([low, high]), axis=0).mean(axis=0))


def hidden(surface: np.ndarray, shape: tuple[int, int], sight: np.ndarray) -> np.ndarray:
    """Return which cells in the middle of a surface others hide: bool of ``shape``; unknown heights (NaN) hide none.

    ``sight``: cells along rows and columns that the line of sight moves for a metre upwards.
    """
    margin = (surface.shape[0] - shape[0]) // 2
    middle = surface[margin : margin + shape[0], margin : margin + shape[1]]
    found, length = np.zeros(shape, bool), float(np.abs(sight).max())
    for cells in range(1, margin + 1 if length else 0):
        row, column = (margin + round(cells * float(part) / length) for part in sight)
        found |= surface[row : row + shape[0], column : column + shape[1]] > middle + cells / length
    return found


def write_ortho_of(
    run: Run, surface: Path, projection: Projection, shift: tuple[float, float, float], progress: Progress
) -> None:
    """Write the raw images of a run, whose points were moved by ``shift`` (metres), resampled to a surface."""
    from sat_intervals.heights.views import sensors_of, views_of  # needs the extra `dsm`

    sides = "left", "right"
    inputs = raw_inputs(*(run.report["inputs"][side]["path"] for side in sides))
    images = [open_input(inputs[side]) for side in sides]
    sensors = sensors_of(images, [inputs[f"{side}_model"]["path"] for side in sides])
    (rows, columns), place = read_place(surface)
    east, north, up = shift
    cells = Cells(place.affine.c - east, place.affine.f - north, place.pixel_size[0], rows, columns)
    lowest, highest = _ends(surface, (rows, columns))
    ground = views_of(sensors, projection, cells, (lowest - up, highest - up + 1), np.zeros((2, 2)))
    meaning = "{} image, resampled to the surface; no data without a height, or where the surface hides the cell"
    bands = [Band(side, "", meaning.format(side)) for side in sides]
    write_orthos(surface, images, replace(ground, lowest=ground.lowest + up), bands, progress)
