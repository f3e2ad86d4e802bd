"""Layers that are written at once."""

import numpy as np
import pytest
import rasterio
from helpers import PLACE

from sat_intervals.raster import Georeferencing, OutputError, read_layers, write_layer


def test_write_layer__keeps_pixels_place_and_tags(tmp_path):
    pixels = np.arange(12, dtype=np.int16).reshape(3, 4)
    write_layer(tmp_path / "a.tif", pixels, -1, PLACE, {"SOFTWARE": "sat-intervals"})
    with rasterio.open(tmp_path / "a.tif") as dataset:
        np.testing.assert_array_equal(dataset.read(1), pixels)
        assert (dataset.nodata, dataset.tags()["SOFTWARE"]) == (-1, "sat-intervals")
        assert Georeferencing.of(dataset) == PLACE
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


# The file has 527 kB. GDAL closes without an error what does not fit.
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("size", [8 << 10, 492 << 10, 512 << 10])
def test_write_layer__leaves_no_damaged_file_on_a_full_disk(disk, size):
    noise = np.random.default_rng(0).integers(0, 60000, (512, 512)).astype(np.uint16)
    place = disk(size)
    with pytest.raises(OutputError, match=r"noise.tif cannot be written: No space left on device: free disk space or"):
        write_layer(place / "noise.tif", noise, 0, Georeferencing())
    assert list(place.iterdir()) == []
    disk(600 << 10)
    write_layer(place / "noise.tif", noise, 0, Georeferencing())
    assert (read_layers(place / "noise.tif")[0] == noise).all()
