"""References on the grid of a surface model."""

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import Affine
from surfaces import PLACE, write_raster

from sat_intervals.raster import Georeferencing
from sat_intervals.raster.surfaces import covered_window, read_heights
from sat_intervals.tiling import Window

GRID = Georeferencing(crs="EPSG:32631", transform=PLACE)
LONGITUDE, LATITUDE = Transformer.from_crs("EPSG:32631", "EPSG:4326", always_xy=True).transform(370_100, 4_829_900)


@pytest.mark.parametrize(
    ("place", "crs", "shape", "expected"),
    [
        (PLACE @ Affine.translation(30, 20), "EPSG:32631", (40, 50), Window(20, 30, 40, 50)),
        (PLACE @ Affine.translation(-5, 190), "EPSG:32631", (40, 50), Window(190, 0, 10, 45)),
        (PLACE @ Affine.translation(30, 60) @ Affine.scale(1, -1), "EPSG:32631", (40, 50), Window(20, 30, 40, 50)),
        (PLACE @ Affine.translation(500, 0), "EPSG:32631", (40, 50), Window(0, 0, 200, 300)),  # apart: unknown
        (Affine(1, 0, -180, 0, -1, 90), "EPSG:4326", (180, 360), Window(0, 0, 200, 300)),  # the whole Earth
    ],
)
def test_covered_window__is_the_part_inside_the_extent_of_the_raster(tmp_path, place, crs, shape, expected):
    reference = write_raster(tmp_path / "reference.tif", [np.zeros(shape)], place, crs)
    assert covered_window(reference, GRID, (200, 300)) == expected


def test_covered_window__in_degrees_is_at_most_some_cells_larger(tmp_path):
    # 40 cells of 1e-5 degrees: 32 m to the east and 44 m to the south of the middle.
    place = Affine(1e-5, 0, LONGITUDE, 0, -1e-5, LATITUDE)
    reference = write_raster(tmp_path / "reference.tif", [np.zeros((40, 40))], place, "EPSG:4326")
    found = covered_window(reference, GRID, (200, 300))
    np.testing.assert_allclose((found.row, found.column, found.height, found.width), (100, 100, 44, 32), atol=4)


@pytest.mark.parametrize("is_inside", [False, True])
@pytest.mark.parametrize("smooth", [False, True])
def test_read_heights__of_a_raster_with_a_mask_and_a_no_data_value_has_neither(tmp_path, is_inside, smooth):
    """GDAL takes the no-data value only."""
    heights, mask = np.full((1, 9, 12), 70, np.float32), np.full((9, 12), 255, np.uint8)
    heights[0, :, :4], heights[0, :, 8:], mask[:, 8:] = -50, 9000, 0
    kind = {"height": 9, "width": 12, "count": 1, "dtype": "float32", "nodata": -50}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=is_inside),
        rasterio.open(tmp_path / "a.tif", "w", "GTiff", crs=GRID.crs, transform=GRID.transform, **kind) as file,
    ):
        file.write(heights)
        file.write_mask(mask)
    read = read_heights(tmp_path / "a.tif", GRID, (9, 12), Window(0, 0, 9, 12), smooth=smooth)
    np.testing.assert_array_equal(np.isfinite(read), np.broadcast_to([False, True, False], (9, 3)).repeat(4, axis=1))
    assert set(read[np.isfinite(read)]) == {70}
