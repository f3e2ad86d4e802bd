"""Write the ortho-image of a sweep: the median of all images, resampled to the surface."""

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.stack import median_of, ortho
from sat_intervals.match.ground import GroundViews
from sat_intervals.products import Band
from sat_intervals.progress import Progress
from sat_intervals.raster import File, OutputWriter, read_layers, read_reduced_views
from sat_intervals.run.job import Job
from sat_intervals.tiling import Window
from sat_intervals.workflows.many import ORTHO

_BAND = Band("grey level", "", "median of the images, resampled to the surface; no data without a height")
# Rows of a strip, and columns of a window in it.
_ROWS, _COLUMNS = 128, 1024


def write_ortho(job: Job, progress: Progress) -> None:
    """Write the ortho-image beside the surface of a finished run; an existing file is replaced."""
    ground = job.prepared.ground
    assert ground
    place, (rows, columns) = job.left.georeferencing, ground.shape
    surface = job.out / "dsm.tif"
    if not surface.exists():
        raise SatIntervalsError(f"{surface} is missing: run the same command with --overwrite")
    file = File(ORTHO, "float32", float("nan"), (_BAND,))
    with OutputWriter(job.out, [file], rows, columns, place, {"SOFTWARE": "sat-intervals"}) as writer:
        for row in range(0, rows, _ROWS):
            progress("ortho", row, rows)
            height = min(_ROWS, rows - row)
            windows = [
                Window(row, first, height, min(_COLUMNS, columns - first)) for first in range(0, columns, _COLUMNS)
            ]
            writer.write(row, np.concatenate([_window(job, ground, window) for window in windows], axis=1)[np.newaxis])
        writer.publish()
        progress("ortho", rows, rows)


def _window(job: Job, ground: GroundViews, window: Window) -> np.ndarray:
    """Return the ortho-image of a window of cells, float32."""
    heights = read_layers(job.out / "dsm.tif", window, band=1)
    known = np.isfinite(heights)
    if not known.any():
        return heights
    disparity = (np.where(known, heights, np.median(heights[known])) - ground.base) / ground.step
    ends = int(np.floor(disparity.min())), int(np.ceil(disparity.max()))
    views = read_reduced_views(job.images.values(), ground.windows(window, *ends), ground.reductions)
    found = np.stack([ortho(view, ground.positions(n, window, disparity)) for n, view in enumerate(views)])
    return np.where(known, median_of(found), np.float32(np.nan)).astype(np.float32)
