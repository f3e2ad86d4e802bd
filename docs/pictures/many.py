"""Draw hillshades of LiDAR and of the surfaces of a pair and of many images, and the half widths of the latter.

Usage: python docs/pictures/many.py LIDAR PAIR MANY PICTURE: LIDAR is a raster of heights, PAIR and MANY are folders
with dsm.tif in cells of the same size.
"""

import sys
from pathlib import Path

import numpy as np

from sat_intervals.raster import read_layers, read_place
from sat_intervals.show.canvas import MapLayer, PlotFrame, draw_layer, draw_map, map_size, page
from sat_intervals.show.relief import relief

CREDIT = "WorldView-3 imagery and LiDAR: IEEE GRSS Data Fusion Contest 2019 (US3D), JHU/APL and IARPA"


def main(lidar: Path, pair: Path, many: Path, target: Path) -> None:
    """Draw the four maps on the cells of the LiDAR."""
    truth = read_layers(lidar)[0].astype(np.float64)
    one, (height, lower, upper) = (on_cells_of(lidar, folder / "dsm.tif") for folder in (pair, many))
    transform = read_place(lidar)[1].transform
    assert transform is not None
    halves, frame = (upper - lower) / 2, PlotFrame.of(truth.shape)
    rows, columns = map_size(truth.shape, 5.0)
    with page(target, (4 * columns + 1.0, rows + 0.6), 90, CREDIT) as figure:
        panels = figure.subplots(1, 4)
        named = ("LiDAR", truth), ("Two images", one[0]), ("Ten images", height)
        for panel, (title, heights) in zip(panels, named, strict=False):
            shade = relief(heights, transform.a, transform.a)
            draw_map(panel, frame, shade, title, cmap="gray", vmin=0, vmax=1)
        draw_layer(panels[-1], frame, MapLayer("Ten: half width", "m", halves, "magma", (0, 10), 0.5))
        for panel in panels:
            panel.set(xticks=[], yticks=[], xlabel="", ylabel="")


def on_cells_of(like: Path, surface: Path) -> np.ndarray:
    """Return height and bounds on the cells of another raster, NaN beyond the surface."""
    shape, (_, place), (_, there) = read_place(like)[0], read_place(like), read_place(surface)
    assert place.transform is not None
    assert there.transform is not None
    cell, layers = place.transform.a, read_layers(surface)[:3].astype(np.float64)
    down, across = (
        round(away / cell) for away in (there.transform.f - place.transform.f, place.transform.c - there.transform.c)
    )
    rows, columns = np.ogrid[down : down + shape[0], across : across + shape[1]]
    inside = (rows >= 0) & (rows < layers.shape[1]) & (columns >= 0) & (columns < layers.shape[2])
    return np.where(inside, layers[:, rows.clip(0, layers.shape[1] - 1), columns.clip(0, layers.shape[2] - 1)], np.nan)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
