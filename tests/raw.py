"""Raw pairs with known heights: the views of a scene as two turned cameras see them, with their RPC models."""

import numpy as np
import rasterio
from cameras import EAST, LATITUDE, LONGITUDE, NORTH, camera
from pyproj import Transformer
from rasterio.rpc import RPC

from sat_intervals.demo import DATUM, PIXEL, VIEWS

TURNS = 0.25, 0.32  # radians from the rows of the scene to those of each raw image


def raw_pair(folder, scene, *, off=0.0, slope=0.0, turns=TURNS):
    """Write left.tif and right.tif with RPC tags; the right model is off by lines, and by a slope of them."""
    from scipy.ndimage import affine_transform  # of the extra `dsm`

    folder.mkdir(exist_ok=True)
    paths = []
    for side, pixels, view, turn in zip(("left", "right"), (scene.left, scene.right), VIEWS, turns, strict=True):
        height, width = pixels.shape
        # column and row in the raw image are `around @ (x, y) + shift`
        around = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        ends = around @ np.array([[0, width, 0, width], [0, 0, height, height]])
        shift, (columns, rows) = -ends.min(axis=1), np.ceil(np.ptp(ends, axis=1)).astype(int)
        back = np.linalg.inv(around)[::-1, ::-1]  # rows first
        raw = affine_transform(
            pixels.astype(float), back, -back @ shift[::-1], output_shape=(rows, columns), order=5, cval=0
        )
        path = camera(
            folder / f"{side}.tif", view, turn=turn, shift=shift, pixels=raw.clip(0, 4095).round().astype(np.uint16)
        )
        _scale(path, *((off, slope) if side == "right" else (0.0, 0.0)))
        paths.append(path)
    return paths


def _scale(path, off, slope):
    """Give the model in an image the scales of the image, and add lines, and a slope of them along columns."""
    with rasterio.open(path, "r+") as dataset:
        known = dataset.rpcs.to_dict()
        line, samp = (np.array(known[f"{axis}_num_coeff"]) for axis in ("line", "samp"))
        line = line + slope * samp
        line[0] += off
        for axis, numbers, size in (("line", line, dataset.height), ("samp", samp, dataset.width)):
            numbers[0] -= size / 2
            known |= {
                f"{axis}_num_coeff": list(numbers / (size / 2)),
                f"{axis}_off": size / 2,
                f"{axis}_scale": size / 2,
            }
        dataset.rpcs, dataset.nodata = RPC(**known), 0


def heights_of(scene):
    """Return map places (EPSG:32631) and heights of the left pixels of a scene."""
    rows, columns = np.indices(scene.truth.shape)
    height = scene.truth / (VIEWS[1] - VIEWS[0]) + DATUM
    known = np.isfinite(height)
    ground = (columns - VIEWS[0] * (height - DATUM))[known] * PIXEL
    degrees = LONGITUDE + ground / EAST, LATITUDE - rows[known] * PIXEL / NORTH
    return *Transformer.from_crs("EPSG:4326", "EPSG:32631", always_xy=True).transform(*degrees), height[known]
