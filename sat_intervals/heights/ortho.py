"""Resample raw images to a surface: an ortho-image on its grid, without the cells that no image sees."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.point_cloud import Cells
from sat_intervals.heights.rectify import raw_inputs
from sat_intervals.kernels.resampling import resample
from sat_intervals.kernels.row_offsets import AFTER, BEFORE
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
from sat_intervals.tiling import View, Window

# Rows of a strip, and columns of a window in it.
_ROWS, _COLUMNS = 128, 1024
_FEW = 1024  # rows and columns that are read for the range of heights


@dataclass(frozen=True)
class Drape:
    """Images over a surface.

    sights: ``(images, 2)`` cells along rows and columns that a line of sight moves for a metre upwards.
    heights: range of the heights in metres.
    """

    surface: Path
    images: Sequence[Image]
    ground: GroundViews
    sights: np.ndarray
    heights: tuple[float, float]

    @classmethod
    def of(cls, surface: Path, images: Sequence[Image], ground: GroundViews) -> "Drape":
        """Return images over the surface of a file, whose cells ``ground`` has."""
        from sat_intervals.heights.views import towards  # needs the extra `dsm`

        (rows, columns), place = read_place(surface)
        ends = _ends(surface, (rows, columns))
        cell = place.pixel_size[0]
        return cls(surface, images, ground, -towards(ground, cell) / cell, ends)

    def write(self, meaning: str, progress: Progress) -> None:
        """Write the ortho-image, the median of the images, beside the surface; an existing file is replaced."""
        (rows, columns), place = read_place(self.surface)
        file = File(ORTHO, "float32", float("nan"), (Band("grey level", "", meaning),))
        tags = {"SOFTWARE": "sat-intervals", "RUNS": read_tags(self.surface).get("RUNS", "")}
        with OutputWriter(self.surface.parent, [file], rows, columns, place, tags) as writer:
            for row in range(0, rows, _ROWS):
                progress("ortho", row, rows)
                height = min(_ROWS, rows - row)
                windows = [
                    Window(row, first, height, min(_COLUMNS, columns - first)) for first in range(0, columns, _COLUMNS)
                ]
                writer.write(row, np.concatenate([self._window(window) for window in windows], axis=1)[np.newaxis])
            writer.publish()
            progress("ortho", rows, rows)

    def _window(self, window: Window) -> np.ndarray:
        """Return the ortho-image of a window of cells, float32."""
        reach = int(np.ceil(np.abs(self.sights).max() * (self.heights[1] - self.heights[0]))) + 1
        around, ground = window.grown(reach, reach), self.ground
        inside = around.clipped(Window(0, 0, *ground.shape))
        all_heights = np.full((around.height, around.width), np.float32(np.nan))
        all_heights[inside.relative_to(around).slices] = read_layers(self.surface, inside, band=1)
        heights = all_heights[window.relative_to(around).slices]
        known = np.isfinite(heights)
        if not known.any():
            return heights
        disparity = (np.where(known, heights, np.median(heights[known])) - ground.base) / ground.step
        ends = int(np.floor(disparity.min())), int(np.ceil(disparity.max()))
        views = read_reduced_views(self.images, ground.windows(window, *ends), ground.reductions)
        found = np.stack([ortho(view, ground.positions(n, window, disparity)) for n, view in enumerate(views)])
        found[np.stack([hidden(all_heights, heights.shape, sight) for sight in self.sights])] = np.nan
        return np.where(known, median_of(found), np.float32(np.nan)).astype(np.float32)


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
    """Write the left raw image of a run, whose points were moved by ``shift`` (metres), resampled to a surface."""
    from sat_intervals.heights.views import sensors_of, views_of  # needs the extra `dsm`

    inputs = raw_inputs(*(run.report["inputs"][side]["path"] for side in ("left", "right")))
    images = [open_input(inputs[side]) for side in ("left", "right")]
    left = sensors_of(images, [inputs[f"{side}_model"]["path"] for side in ("left", "right")])[:1]
    (rows, columns), place = read_place(surface)
    east, north, up = shift
    cells = Cells(place.affine.c - east, place.affine.f - north, place.pixel_size[0], rows, columns)
    lowest, highest = _ends(surface, (rows, columns))
    ends = lowest - up, highest - up + 1
    ground = views_of(left, projection, cells, ends, np.zeros((1, 2)))
    ground = replace(ground, lowest=ground.lowest + up)
    Drape.of(surface, images[:1], ground).write(
        "left image, resampled to the surface; no data without a height, or where the surface hides the cell", progress
    )
