"""Analytic cameras: RPC models and epipolar grids of views whose columns are ground columns + view x height."""

import numpy as np
import rasterio
from rasterio.rpc import RPC
from rasterio.transform import Affine

from sat_intervals.demo import DATUM, PIXEL, VIEWS

# Where the scene stands, and metres in a degree there, of longitude and of latitude.
LONGITUDE, LATITUDE = 1.45, 43.6
EAST, NORTH = 80_700.0, 111_110.0


def camera(path, view, longitude=LONGITUDE, *, turn=0.0, shift=(0.0, 0.0), pixels=None):
    """Write an image and the RPC of a view: x = u + view (h - h0), y down the latitudes; u in pixels, h in metres.

    Its columns and rows are x and y, turned clockwise by an angle in radians and shifted.
    """
    scale = 0.01, 60.0  # degrees, metres; over a few metres lines in degrees are straight
    x, y, one = np.zeros(20), np.zeros(20), np.eye(20)[0]
    x[1], x[3] = EAST / PIXEL * scale[0], view * scale[1]
    y[2] = -NORTH / PIXEL * scale[0]
    column = np.cos(turn) * x - np.sin(turn) * y + shift[0] * one
    line = np.sin(turn) * x + np.cos(turn) * y + shift[1] * one
    rpc = RPC(
        line_off=0.0, line_scale=1.0, samp_off=0.0, samp_scale=1.0,
        lat_off=LATITUDE, lat_scale=scale[0], long_off=longitude, long_scale=scale[0],
        height_off=DATUM, height_scale=scale[1],
        line_num_coeff=list(line), line_den_coeff=list(one), samp_num_coeff=list(column), samp_den_coeff=list(one),
    )  # fmt: skip
    pixels = np.zeros((8, 8), np.uint8) if pixels is None else pixels
    height, width = pixels.shape
    kind = {"height": height, "width": width, "count": 1, "dtype": pixels.dtype}
    with rasterio.open(path, "w", driver="GTiff", rpcs=rpc, **kind) as dataset:
        dataset.write(pixels, 1)
    return path


def grid(path, rows, columns, *, step=20, offset=0.5):
    """Write the grid that maps every epipolar position to the same sensor position; first pixel centre at 0.5."""
    row, column = (np.arange(-2 * step, size + 3 * step, step, dtype=np.float64) for size in (rows, columns))
    positions = np.stack(np.broadcast_arrays(column + offset, row[:, None] + offset))
    place = Affine(step, 0, column[0] - step / 2, 0, step, row[0] - step / 2)
    kind = {"height": row.size, "width": column.size, "count": 2, "dtype": "float64"}
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:4326", transform=place, **kind) as dataset:
        dataset.write(positions)
    return path


def cameras(folder, rows, columns, longitude=LONGITUDE, views=VIEWS):
    """Write both models and both grids of a pair; returns their paths."""
    return [
        camera(folder / "left_model.tif", views[0], longitude),
        camera(folder / "right_model.tif", views[1], longitude),
        grid(folder / "left_grid.tif", rows, columns),
        grid(folder / "right_grid.tif", rows, columns),
    ]


def sensor_words(files):
    """Return the options of a command that name these models and grids."""
    options = "--left-model", "--right-model", "--left-grid", "--right-grid"
    return [word for pair in zip(options, files, strict=True) for word in pair]
