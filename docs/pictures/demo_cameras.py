"""Write sensor models, epipolar grids and exact heights of the demo scene, for pictures of its surface model.

Usage: python demo_cameras.py FOLDER. Writes left_model.tif, right_model.tif, left_grid.tif, right_grid.tif, lidar.tif.
"""

import sys
from pathlib import Path

import numpy as np
import rasterio
from rasterio.rpc import RPC
from rasterio.transform import Affine

from sat_intervals.demo import DATUM, PIXEL, VIEWS, profiles

LONGITUDE, LATITUDE = 1.45, 43.6  # of the first pixel
EAST, NORTH = 80_700.0, 111_110.0  # metres in a degree there
STEP = 20  # pixels between the nodes of a grid


def write_model(path: Path, view: float) -> None:
    """Write the RPC of a view: column = ground column + view * (height - DATUM), row = southing."""
    degrees, metres = 0.01, 60.0
    column, line, one = np.zeros(20), np.zeros(20), np.eye(20)[0]
    column[1], column[3] = EAST / PIXEL * degrees, view * metres
    line[2] = -NORTH / PIXEL * degrees
    rpcs = RPC(
        line_off=0.0,
        line_scale=1.0,
        samp_off=0.0,
        samp_scale=1.0,
        lat_off=LATITUDE,
        lat_scale=degrees,
        long_off=LONGITUDE,
        long_scale=degrees,
        height_off=DATUM,
        height_scale=metres,
        line_num_coeff=list(line),
        line_den_coeff=list(one),
        samp_num_coeff=list(column),
        samp_den_coeff=list(one),
    )
    kind = {"height": 8, "width": 8, "count": 1, "dtype": "uint8", "crs": "EPSG:4326", "rpcs": rpcs}
    with rasterio.open(path, "w", driver="GTiff", **kind) as dataset:
        dataset.write(np.zeros((1, 8, 8), np.uint8))


def write_grid(path: Path, rows: int, columns: int) -> None:
    """Write the grid that maps every epipolar position to the same sensor position."""
    row, column = (np.arange(-2 * STEP, size + 3 * STEP, STEP, dtype=np.float64) for size in (rows, columns))
    positions = np.stack(np.broadcast_arrays(column + 0.5, row[:, None] + 0.5))
    place = Affine(STEP, 0, column[0] - STEP / 2, 0, STEP, row[0] - STEP / 2)
    kind = {"height": row.size, "width": column.size, "count": 2, "dtype": "float64"}
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:4326", transform=place, **kind) as dataset:
        dataset.write(positions)


def write_heights(path: Path, rows: int, columns: int) -> None:
    """Write the height of the ground at the centres of the scene's pixels."""
    heights = np.stack([np.interp(np.arange(columns), u, height) for _, u, height, _ in profiles(rows, columns)])
    width, height = PIXEL / EAST, PIXEL / NORTH
    place = Affine(width, 0, LONGITUDE - width / 2, 0, -height, LATITUDE + height / 2)
    kind = {"height": rows, "width": columns, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:4326", transform=place, **kind) as dataset:
        dataset.write(heights[np.newaxis])


folder = Path(sys.argv[1])
with rasterio.open(folder / "left.tif") as image:
    size = image.shape
for name, tilt in zip(("left", "right"), VIEWS, strict=True):
    write_model(folder / f"{name}_model.tif", tilt)
    write_grid(folder / f"{name}_grid.tif", *size)
write_heights(folder / "lidar.tif", *size)
