"""Folders of finished runs: what is read of them, and one line about what is missing or does not fit."""

import numpy as np
import pytest
from finished import random_bands, write_run
from helpers import PLACE, invoke

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import write_layer
from sat_intervals.results import open_results, open_run
from sat_intervals.tiling import Window


def test_open_results__reads_bands_image_and_truth(tmp_path):
    bands, validity, truth = random_bands(20, 30)
    out = write_run(tmp_path, bands, validity, truth)
    results = open_results(out)
    read = results.read(Window(3, 4, 5, 6))
    np.testing.assert_array_equal(read[:4], bands[:, 3:8, 4:10])
    np.testing.assert_array_equal(read.validity, validity[3:8, 4:10])
    np.testing.assert_array_equal(read.truth, truth[3:8, 4:10])
    assert (read.image > 0).all()
    assert [row for row, _ in results.strips()] == [0]
    assert results.read_pixel(3, 4).validity == validity[3, 4]


@pytest.mark.parametrize("content", [b"", b"{", b"\xff", b"[]"])
def test_open_run__names_a_report_that_is_not_json(tmp_path, content):
    (tmp_path / "run.json").write_bytes(content)
    with pytest.raises(SatIntervalsError, match=r"run\.json is not the report of a run"):
        open_run(tmp_path)


def test_open_run__names_a_folder_without_a_report_or_a_raster(tmp_path):
    with pytest.raises(SatIntervalsError, match=r"run\.json: No such file or directory: give the folder of a finished"):
        open_run(tmp_path)
    out = write_run(tmp_path, *random_bands(20, 30))
    (out / "validity.tif").unlink()
    with pytest.raises(SatIntervalsError, match=r"validity\.tif: no such file: give the folder of a finished run, or"):
        open_run(out)


def test_layer__names_a_raster_that_is_not_of_the_run(tmp_path, caplog):
    run = open_run(write_run(tmp_path, *random_bands(20, 30)))
    write_layer(tmp_path / "small.tif", np.zeros((9, 9), np.float32), np.nan, PLACE)
    with pytest.raises(SatIntervalsError, match=r"small\.tif has 9 x 9 pixels, .*: give a file of such a size"):
        run.layer(tmp_path / "small.tif")
    write_layer(tmp_path / "a.tif", np.zeros((20, 30), np.float32), np.nan, PLACE, {"REGION": "rows 7 to 26"})
    with pytest.raises(SatIntervalsError, match=r"a\.tif is of rows 7 to 26, .*: give one of this run"):
        run.layer(tmp_path / "a.tif")
    write_layer(tmp_path / "b.tif", np.zeros((20, 30), np.float32), np.nan, PLACE, {"LEFT_SHA256": "00"})
    run.report["inputs"]["left"]["sha256"] = "11"
    run.layer(tmp_path / "b.tif")
    assert "b.tif was made for another left image than" in caplog.text


def test_check_kept__keeps_the_run_and_its_inputs(tmp_path):
    run = open_run(write_run(tmp_path, *random_bands(20, 30)))
    for file in (tmp_path / "left.tif", run.out / "run.json", run.out / "validity.tif"):
        with pytest.raises(SatIntervalsError, match=f"{file.name} is an input"):
            run.check_kept([file])
    run.check_kept([run.out / "report.html"])


@pytest.mark.parametrize("command", ["report", "plot"])
def test_commands__name_an_image_of_the_run_that_is_missing(tmp_path, command):
    out = write_run(tmp_path, *random_bands(20, 30))
    (tmp_path / "left.tif").rename(tmp_path / "moved.tif")
    done = invoke(command, out)
    assert done.exit_code == 2
    assert (
        f"{tmp_path}/left.tif, an image of the run, is missing: move it back, or put a link to it there" in done.stderr
    )
    (tmp_path / "left.tif").symlink_to("moved.tif")
    assert invoke(command, out).exit_code == 0
