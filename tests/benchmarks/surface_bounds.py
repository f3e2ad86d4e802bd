"""The table of docs/heights.md (`make surface-bounds`): coverage and width of the bounds of cells, on exact scenes.

Towns, slopes and rough ground, at three base-to-height ratios, are matched with a coverage of .90. Points come from the
analytic cameras of the scenes. The envelope keeps open intervals, as without a coverage; the others leave them out. The
truth of a cell is the height of the surface, seen from above, at its centre. Cells near a wall are apart: heights
within one cell of the centre differ by more than 2.2 px of disparity, and more than the side of the cell.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer

from sat_intervals import demo, match_pair
from sat_intervals.demo import DATUM, PIXEL
from sat_intervals.heights.choices import BOUNDS, SurfaceChoices
from sat_intervals.heights.dsm import make_surface
from sat_intervals.products import POINTS
from sat_intervals.raster import POINT_FILES, Georeferencing, OutputWriter, north_up, write_layer
from sat_intervals.results import open_run
from sat_intervals.tiling import Window

SIZE, SEED = int(sys.argv[1]) if len(sys.argv) > 1 else 360, 5
VIEWS = {0.3: (-0.2, 0.4), 0.5: (-0.4, 0.6), 0.8: (-0.6, 1.0)}
KINDS = {"town": 0, "slope": 60, "rough": 10}  # metres of relief
LONGITUDE, LATITUDE = 1.45, 43.6
EAST, NORTH = 80_700.0, 111_110.0  # metres in a degree there
CRS = "EPSG:32631"
OBJECTS, TERRAIN = demo.OBJECTS, demo._terrain


def rough(ground, r, c):
    """The terrain with bumps of some metres, 14 px apart."""
    return TERRAIN(ground, r, c) + 4 + 3 * demo._noise(ground.lattice, r, c, 14, 3)


def make_pair(folder, kind, ratio):
    """Write and match a pair; return its profiles, one for each row."""
    demo.VIEWS = VIEWS[ratio]
    demo.OBJECTS = OBJECTS if kind == "town" else ()
    demo._terrain = rough if kind == "rough" else TERRAIN
    scene = demo.make_scene(SIZE, SIZE, SEED, relief=KINDS[kind])
    place = north_up(32631, x=370_000, y=4_830_000, pixel=PIXEL)
    for name, image in (("left", scene.left), ("right", scene.right)):
        write_layer(folder / f"{name}.tif", image, 0, place)
    search = {"minimum": scene.minimum, "maximum": scene.maximum}
    settings = {"preset": "satellite", "disparity": search, "interval": {"coverage": 0.9}}
    match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    return list(demo.profiles(SIZE, SIZE, SEED, 0, 64, KINDS[kind]))


def write_points(out, views):
    """Write the points of a run, as its analytic cameras give them."""
    run = open_run(out)
    bands = run.read_bands(Window(0, 0, *run.shape))
    disparities = np.where(bands.valid, bands[:3], np.nan).astype(np.float64)
    height, lower, upper = DATUM + disparities / (views[1] - views[0])
    row, column = np.indices(run.shape)
    layers = {
        "longitude": LONGITUDE + (column - views[0] * (height - DATUM)) * PIXEL / EAST,
        "latitude": np.where(np.isnan(height), np.nan, LATITUDE - row * PIXEL / NORTH),
        "height": height, "height_lower": lower, "height_upper": upper,
    }  # fmt: skip
    points = np.stack([layers.get(band.name, np.zeros(run.shape)) for band in POINTS])
    with OutputWriter(out, POINT_FILES, *run.shape, Georeferencing(), {"RUN": run.report["finished"]}) as writer:
        writer.write(0, points)
        writer.publish()


def truth_of(place, shape, profiles):
    """Height at the centres of cells, and the range of heights within one cell of them; NaN outside the scene."""
    back = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)

    def at(down, across):
        row, column = np.indices(shape)
        longitude, latitude = back.transform(*(place * (column + 0.5 + across, row + 0.5 + down)))
        u, v = (longitude - LONGITUDE) * EAST / PIXEL, np.rint((LATITUDE - latitude) * NORTH / PIXEL).astype(int)
        height = np.full(shape, np.nan)
        for row in range(SIZE):
            here = (v == row) & (u >= 0) & (u < SIZE)
            height[here] = np.interp(u[here], *profiles[row][1:3])
        return height

    steps = np.linspace(-1, 1, 5)
    return at(0, 0), np.ptp([at(down, across) for down in steps for across in steps], axis=0)


def figures(path, truth, walls, pixel):
    """Coverage of all cells, outside walls and near them; median and mean width in pixels; filled share."""
    with rasterio.open(path) as dataset:
        lower, upper = dataset.read((2, 3)).astype(np.float64)
    known = np.isfinite(truth) & np.isfinite(lower)
    inside, width, wall = ((lower <= truth) & (truth <= upper))[known], ((upper - lower) / pixel)[known], walls[known]
    near = inside[wall].mean() if wall.any() else np.nan
    return inside.mean(), inside[~wall].mean(), near, np.median(width), width.mean(), known.sum()


def main():
    print("| scene | base-to-height | cell | bounds | coverage | without walls | walls | median width | mean width |")
    print("|---|---|---|---|---|---|---|---|---|")
    means = {}
    for kind in KINDS:
        for ratio, views in VIEWS.items():
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                profiles = make_pair(folder, kind, ratio)
                write_points(folder / "out", views)
                pixel = 1 / (views[1] - views[0])
                for cell in (1, 2, 4):
                    truth = None
                    for bounds in BOUNDS:
                        choices = SurfaceChoices(bounds, keeps_open=bounds == "envelope")
                        path = folder / "dsm.tif"
                        make_surface([folder / "out"], path, resolution=cell * PIXEL, crs=CRS, choices=choices)
                        if truth is None:
                            with rasterio.open(path) as dataset:
                                truth, range_ = truth_of(dataset.transform, dataset.shape, profiles)
                            walls = range_ > max(2.2 * pixel, cell * PIXEL)
                        row = figures(path, truth, walls, pixel)
                        means.setdefault((cell, bounds), []).append(row)
                        print(f"| {kind} | {ratio} | {cell} px | {bounds} | {written(row)} |", flush=True)
    for (cell, bounds), rows in means.items():
        print(f"| mean | | {cell} px | {bounds} | {written(np.nanmean(rows, axis=0))} |")


def written(row):
    """The figures of a line of the table."""
    return " | ".join([*(f"{share:.3f}" for share in row[:3]), *(f"{width:.2f}" for width in row[3:5])])


main()
