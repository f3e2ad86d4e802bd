"""Nothing waits forever: YAML without end, images and files that are too large."""

import subprocess
import time

import numpy as np
import pytest
import rasterio
from helpers import COMMAND

from sat_intervals import load_config
from sat_intervals.config import ConfigError, Mccnn
from sat_intervals.config.pairs import read_batch
from sat_intervals.config.weights import weights_file
from sat_intervals.errors import SatIntervalsError


def write(path, **options):
    profile = {"driver": "GTiff", "height": 9, "width": 9, "count": 1, "dtype": "uint8", "crs": "EPSG:32631"}
    with rasterio.open(path, "w", transform=rasterio.Affine(1, 0, 3e5, 0, -1, 4e6), **profile | options) as file:
        file.write(np.ones((9, 9), np.uint8), 1)
    return path


# ---- YAML --------------------------------------------------------------------------------------------------------
def bomb(levels, wrap):
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{i}: &a{i} " + wrap.format(", ".join(9 * [f"*a{i - 1}"])) for i in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize("wrap", ["{{<<: [{}]}}", "[{}]"])
def test_load_config__refuses_yaml_that_repeats_itself_without_end(tmp_path, wrap):
    file = tmp_path / "settings.yaml"
    file.write_text(bomb(9, wrap))
    began = time.monotonic()
    with pytest.raises(ConfigError, match=r"settings.yaml: line 5: more than 10000 values, aliases expanded"):
        load_config(file)
    assert time.monotonic() - began < 2
    pairs = tmp_path / "pairs.csv"
    cell = bomb(9, wrap).replace('"', '""')
    pairs.write_text(f'name,left,right,sgm\na,b,c,"{cell}"\n')
    with pytest.raises(SatIntervalsError, match=r"row 1: sgm is .* more than 10000 values"):
        read_batch(pairs)


def test_load_config__takes_aliases_and_merge_keys(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("disparity: &range {minimum: -3, maximum: 4}\n")
    plain = load_config(file)
    file.write_text("disparity: {<<: [{minimum: -3}, {maximum: 4}]}\n")
    assert load_config(file) == plain


def test_read_small__refuses_a_large_file(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("#" * 1_000_001)
    for read in (load_config, read_batch):
        with pytest.raises(SatIntervalsError, match=r"settings.yaml has more than 1 MB: is it the right file\?$"):
            read(file)


# ---- Sizes -------------------------------------------------------------------------------------------------------
def test_weights_file__refuses_a_large_file_before_it_is_read(tmp_path):
    file = tmp_path / "zeros.onnx"
    with file.open("wb") as stream:
        stream.truncate(3 * 10**9)
    began = time.monotonic()
    with pytest.raises(SatIntervalsError, match=r"zeros.onnx has 3000 MB, a network like MC-CNN has less than 256 MB"):
        weights_file(Mccnn(weights=str(file)).weights)
    assert time.monotonic() - began < 1


@pytest.mark.parametrize("command", ["plan", "plan --disparity 0 4", "match", "match --disparity 0 4", "range"])
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
