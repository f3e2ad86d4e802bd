"""Draw the hillshade of a surface model beside the half widths of its intervals.

Usage: python docs/pictures/surface.py OUT PICTURE: OUT is a finished run with dsm.tif.
"""

import sys
from pathlib import Path

import numpy as np

from sat_intervals.raster import read_layers, read_place
from sat_intervals.show.canvas import GROUND, MapLayer, PlotFrame, draw_layer, draw_map, map_size, page
from sat_intervals.show.relief import relief

CREDIT = "Pleiades imagery (c) CNES, distribution Airbus DS, published by CNES with Picanteo; Open Licence 2.0 (Etalab)"


def main(out: Path, target: Path) -> None:
    """Draw both maps."""
    surface = out / "dsm.tif"
    height, lower, upper = read_layers(surface)[:3].astype(np.float64)
    shape, place = read_place(surface)
    assert place.transform is not None
    cell = place.transform.a
    left, top = place.transform.c, place.transform.f
    frame = PlotFrame(left, left + shape[1] * cell, top - shape[0] * cell, top, GROUND)
    rows, columns = map_size(shape, 5.0)
    halves = (upper - lower) / 2
    with page(target, (2 * columns + 2.0, rows + 1.0), 90, CREDIT) as figure:
        first, second = figure.subplots(1, 2)
        draw_map(first, frame, relief(height, cell, cell), "Surface model, cells of 1 m", cmap="gray", vmin=0, vmax=1)
        title = f"Half width of the intervals, median {np.nanmedian(halves):.2f} m"
        draw_layer(second, frame, MapLayer(title, "m", halves, "magma", (0, 20), 0.5))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
