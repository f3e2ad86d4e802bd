"""Nothing waits forever: images that are too large."""

import subprocess

import numpy as np
import pytest
import rasterio
from helpers import COMMAND


def write(path, **options):
    profile = {"driver": "GTiff", "height": 9, "width": 9, "count": 1, "dtype": "uint8", "crs": "EPSG:32631"}
    with rasterio.open(path, "w", transform=rasterio.Affine(1, 0, 3e5, 0, -1, 4e6), **profile | options) as file:
        file.write(np.ones((9, 9), np.uint8), 1)
    return path


@pytest.mark.parametrize("command", ["plan --disparity 0 4", "match", "range"])
def test_endless_image__is_refused(tmp_path, command):
    source = write(tmp_path / "small.tif")
    side = 2 * 10**9
    vrt = tmp_path / "endless.vrt"
    vrt.write_text(
        f'<VRTDataset rasterXSize="{side}" rasterYSize="{side}"><VRTRasterBand dataType="Byte" band="1">'
        f"<SimpleSource><SourceFilename>{source}</SourceFilename><SourceBand>1</SourceBand></SimpleSource>"
        "</VRTRasterBand></VRTDataset>"
    )
    command, *options = command.split()
    given = [tmp_path / "out", *options] if command == "match" else options
    # a process of its own: an endless list of blocks could not be interrupted here
    run = [COMMAND, command, vrt, vrt, *given]
    result = subprocess.run(run, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert "GB" in result.stderr
