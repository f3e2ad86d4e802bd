"""The CRC-32 inside surface models and true disparities: whatever reads a damaged one refuses it."""

import numpy as np
import pytest
import rasterio
from finished import FINISHED, PLACE, random_bands, write_points, write_run
from helpers import flip_bit, invoke
from rasterio.errors import RasterioDeprecationWarning
from rasterio.shutil import copy
from rio_cogeo.cogeo import cog_validate
from surfaces import write_raster

from sat_intervals import SatIntervalsError
from sat_intervals.products import SURFACE
from sat_intervals.raster import OutputWriter, cog, surface_file, truth_file
from sat_intervals.raster.seal import check_seal


def write(path, file, bands, tags=None):
    """Write bands as `make_surface` and `make_truth` do."""
    with OutputWriter(path.parent, [file(path.name)], *bands.shape[1:], PLACE, tags or {}) as writer:
        writer.write(0, bands)
        made = writer.build()
        writer.publish()
    return made[path.name]


@pytest.fixture(scope="module")
def heights():
    return np.random.default_rng(0).normal(700, 1, (len(SURFACE), 40, 50)).astype(np.float32)


@pytest.mark.parametrize("is_big", [False, True])
def test_check_seal__finds_every_flipped_bit(tmp_path, monkeypatch, heights, is_big):
    monkeypatch.setattr(cog, "_CLASSIC", 0 if is_big else 1 << 32)
    path = tmp_path / "dsm.tif"
    made = write(path, surface_file, heights, {"HEIGHTS": "SAT_INTERVALS_CRC_32=00000000\n"})
    whole = path.read_bytes()
    assert made["bytes"] == len(whole)
    assert cog_validate(path, strict=True) == (True, [], [])
    with rasterio.open(path) as dataset:
        np.testing.assert_array_equal(dataset.read(), heights)
    check_seal(path, [])
    line = whole.index(b"SAT_INTERVALS_CRC_32=")
    for place in {*range(0, len(whole), len(whole) // 30), line + 28} - set(range(line, line + 21)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(SatIntervalsError, match=r"dsm.tif is damaged or was changed: its CRC-32 is .*: move it"):
            check_seal(path, [])
    path.write_bytes(whole[:-1])
    with pytest.raises(SatIntervalsError, match="is damaged"):
        check_seal(path, [])


def test_check_seal__of_a_file_of_another_tool_passes(tmp_path, heights):
    write(tmp_path / "dsm.tif", surface_file, heights)
    copy(str(tmp_path / "dsm.tif"), str(tmp_path / "copy.tif"), driver="COG", compress="lzw")
    check_seal(tmp_path / "copy.tif", ["other.ovr"])
    check_seal(tmp_path / "missing.tif", [])


@pytest.fixture(scope="module")
def damaged(tmp_path_factory, heights):
    """A run with a surface and a truth, both whole at first, and a reference."""
    folder = tmp_path_factory.mktemp("damaged")
    bands, validity, truth = random_bands(40, 50)
    out = write_run(folder, bands, validity)
    write_raster(folder / "reference.tif", heights[:1] + 1, PLACE.transform)
    write(out / "dsm.tif", surface_file, heights, {"RUNS": FINISHED, "ALPHA": "0.9"})
    write(out / "truth.tif", truth_file, truth[np.newaxis])
    surface, given = ["--dsm", out / "dsm.tif", "--reference", folder / "reference.tif"], ["--truth", out / "truth.tif"]
    commands = {
        "evaluate": ("evaluate", *surface),
        "calibrate": ("calibrate", *surface, "--output", folder / "heights.yaml"),
        "plot": ("plot", out),
        "project": ("project", out),
        "stac": ("stac", out),
        "evaluate --truth": ("evaluate", out, *given),
        "report --truth": ("report", out, *given),
    }
    assert invoke(*commands["evaluate"]).exit_code == invoke(*commands["evaluate --truth"]).exit_code == 0
    flip_bit(out / "dsm.tif")
    flip_bit(out / "truth.tif")
    return commands


@pytest.mark.parametrize(
    "name", ["evaluate", "calibrate", "plot", "project", "stac", "evaluate --truth", "report --truth"]
)
def test_commands__refuse_a_surface_or_truth_of_which_a_bit_flipped(damaged, name):
    done = invoke(*damaged[name])
    assert f"{'truth' if 'truth' in name else 'dsm'}.tif is damaged or was changed: its CRC-32 is" in done.stderr
    assert done.exit_code == 2


@pytest.fixture(scope="module")
def whole(tmp_path_factory, heights):
    """A run with points, a surface and a truth, and a reference."""
    folder = tmp_path_factory.mktemp("whole")
    bands, validity, truth = random_bands(40, 50)
    out = write_run(folder, bands, validity)
    write_points(out, heights[0])
    write(out / "dsm.tif", surface_file, heights, {"RUNS": FINISHED})
    write(out / "truth.tif", truth_file, truth[np.newaxis])
    return out


@pytest.mark.parametrize("name", ["intervals.tif", "validity.tif", "points.tif", "dsm.tif", "truth.tif"])
def test_commands__refuse_files_beside_ours_that_change_them(whole, name):
    judging = ["evaluate", whole, "--truth", whole / "truth.tif"]
    command = ["project", whole] if name in ("points.tif", "dsm.tif") else judging
    beside, band = whole / f"{name}.aux.xml", '<PAMRasterBand band="1"><Metadata>{}</Metadata></PAMRasterBand>'
    statistics = band.format('<MDI key="STATISTICS_MEAN">1</MDI>')
    key = '<Metadata><MDI key="HEIGHTS">above me</MDI></Metadata>'
    for content in (
        "<SRS>EPSG:4326</SRS>",
        key,
        '<PAMRasterBand band="1"><NoDataValue>1</NoDataValue></PAMRasterBand>',
        '<PAMRasterBand band="1">< NoDataValue>1</ NoDataValue></PAMRasterBand>',  # GDAL reads it
    ):
        beside.write_text(f"<PAMDataset>{statistics}{content}</PAMDataset>")
        done = invoke(*command)
        assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
        assert f"{beside} changes what is read from {whole / name}: move it away" in done.stderr
    beside.unlink()
    with rasterio.open(whole / name) as dataset, pytest.warns(RasterioDeprecationWarning):  # as QGIS
        dataset.statistics(1, approx=False)
    assert "STATISTICS_MEAN" in beside.read_text()
    assert invoke(*command).exit_code == 0
    beside.rename(beside.with_name("kept"))
    mask = whole / f"{name}.msk"
    write_raster(mask, np.zeros((1, 40, 50)))
    with rasterio.open(mask, "r+") as dataset:
        dataset.update_tags(INTERNAL_MASK_FLAGS_1="2")
    assert f"{mask} changes what is read" in invoke(*command).stderr
    mask.unlink()
