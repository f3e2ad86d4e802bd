"""Files of the user: no output replaces an input."""

import json
import re
import shutil

import pytest
import rasterio
from finished import random_bands, write_run
from helpers import VRT, contents, refused
from rasterio.shutil import copy

from sat_intervals.config.batch import PairOfBatch
from sat_intervals.errors import SatIntervalsError
from sat_intervals.interop.export import export
from sat_intervals.run.pair import match_pair
from sat_intervals.workflows.batch import match_batch

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.mark.parametrize("way", ["path", "tiles", "source of a mask"])
def test_match__refuses_an_input_that_it_would_lose(small_pair, way):
    folder, _ = small_pair
    out, left, options = folder / "out", folder / "left.tif", []
    (out / "tiles").mkdir(parents=True)
    if way == "path":
        left = shutil.copy(left, out / "intervals.tif")
    elif way == "tiles":
        left = shutil.copy(left, out / "tiles" / "left.tif")
    else:
        shutil.copy(folder / "mask.tif", out / "validity.tif")
        (folder / "source.vrt").write_text(VRT.replace("mask.tif", "out/validity.tif"))
        options = ["--left-mask", folder / "source.vrt"]
    before = contents(folder)
    command = ["match", left, folder / "right.tif", out, "--config", folder / "settings.yaml", "--overwrite"]
    refused([*command, *options], "is an input", "choose another output")
    assert contents(folder) == before


@pytest.mark.parametrize("name", ["run.json", "tiles/manifest.json"])
def test_commands__refuse_settings_that_they_would_lose(small_pair, name):
    folder, _ = small_pair
    for out in (folder / "out", folder / "batch" / "one"):
        (out / "tiles").mkdir(parents=True)
        shutil.copy(folder / "settings.yaml", out / name)
    rows = [{"name": "one", "left": str(folder / "left.tif"), "right": str(folder / "right.tif")}]
    (folder / "pairs.json").write_text(json.dumps(rows))
    before = contents(folder)
    config = ["--config", folder / "out" / name, "--overwrite"]
    refused(["match", folder / "left.tif", folder / "right.tif", folder / "out", *config], f"{name} is an input")
    refused(["demo", folder / "out", "--size", "100", "100", *config], f"{name} is an input")
    config = ["--config", folder / "batch" / "one" / name, "--overwrite"]
    refused(["batch", folder / "pairs.json", folder / "batch", *config], f"{name} is an input")
    assert contents(folder) == before


def test_batch__refuses_an_input_that_another_pair_or_its_report_would_replace(small_pair):
    folder, settings = small_pair
    out = folder / "out"
    (out / "one").mkdir(parents=True)
    shutil.copy(folder / "mask.tif", out / "one" / "validity.tif")
    images = str(folder / "left.tif"), str(folder / "right.tif")
    pairs = [PairOfBatch("one", *images), PairOfBatch("two", *images, left_mask=str(out / "one" / "validity.tif"))]
    before = contents(folder)
    with pytest.raises(SatIntervalsError, match=r"is an input, and .* would be written"):
        match_batch(pairs, out, settings, overwrite=True)
    assert contents(folder) == before
    (out / "batch.json").write_text(json.dumps([{"name": "one", "left": images[0], "right": images[1]}]))
    before = contents(folder)
    refused(["batch", out / "batch.json", out, "--config", folder / "settings.yaml"], "batch.json is an input")
    assert contents(folder) == before


def test_log_file__is_no_input(small_pair):
    folder, _ = small_pair
    before = contents(folder)
    command = ["match", folder / "left.tif", folder / "right.tif", folder / "out", "--disparity", "-18", "40"]
    refused([*command, "--log-file", folder / "left.tif"], "left.tif is an input")
    assert contents(folder) == before


@pytest.fixture
def finished(tmp_path):
    """A made-up run with its images; the left image has a name that each tool writes to."""
    return write_run(tmp_path, *random_bands(40, 50))


def rename_left(out, name):
    """Give the left image of a run another name beside its files."""
    report = json.loads((out / "run.json").read_text())
    shutil.move(report["inputs"]["left"]["path"], out / name)
    report["inputs"]["left"]["path"] = str(out / name)
    (out / "run.json").write_text(json.dumps(report))


@pytest.mark.parametrize(
    ("form", "name"), [("otb", "mask.tif"), ("s2p", "rectified_disp.tif"), ("cars", "epi_disp.tif")]
)
def test_export__refuses_to_replace_an_image_of_the_run(finished, form, name):
    rename_left(finished, name)
    before = contents(finished)
    with pytest.raises(SatIntervalsError, match=rf"{name} is an input"):
        export(finished, form, finished)
    assert contents(finished) == before


def test_report_and_plot__refuse_to_replace_an_image_of_the_run(finished):
    rename_left(finished, "report.html")
    before = contents(finished)
    refused(["report", finished], "report.html is an input")
    shutil.move(finished / "report.html", finished / "left.tif")
    rename_left_back = json.loads((finished / "run.json").read_text())
    rename_left_back["inputs"]["left"]["path"] = str(finished / "left.tif")
    (finished / "run.json").write_text(json.dumps(rename_left_back))
    rename_left(finished, "overview.png")
    refused(["plot", finished], "overview.png is an input")
    assert (finished / "overview.png").read_bytes() == before[str(finished / "report.html")]


def test_match_pair__keeps_a_result_that_is_the_source_of_ranges(small_pair):
    folder, settings = small_pair
    images, out = (folder / "left.tif", folder / "right.tif"), folder / "out"
    match_pair(*images, out, settings)
    with rasterio.open(out / "intervals.tif") as file:
        copy(file, folder / "ranges.vrt", driver="VRT")
    text = (folder / "ranges.vrt").read_text()
    bands = re.findall(r"<VRTRasterBand.*?</VRTRasterBand>", text, re.DOTALL)
    for band in (bands[0], bands[3]):
        text = text.replace(band, "")
    (folder / "ranges.vrt").write_text(text.replace('band="2"', 'band="1"', 1).replace('band="3"', 'band="2"', 1))
    ranges = {**settings, "disparity": {**settings["disparity"], "grid": str(folder / "ranges.vrt")}}
    with pytest.raises(SatIntervalsError, match=r"intervals.tif is an input, and .*intervals.tif would be written"):
        match_pair(*images, out, ranges, overwrite=True)
