"""Change between two dates: surfaces with known changes, errors within their intervals, and a shift."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from helpers import invoke, refused
from rasterio.transform import Affine
from surfaces import PLACE, write_raster, write_surface

import sat_intervals
from sat_intervals.evaluate.change import open_pair
from sat_intervals.evaluate.change_areas import ChangedAreas, signs_of
from sat_intervals.kernels import registration
from sat_intervals.products import SURFACE
from sat_intervals.raster import read_layers
from sat_intervals.raster.vertical import horizontal

SIDE, HALF = 180, 1.0  # cells of 1 m, half width of intervals at coverage .9
SHIFT = 1.5, -2.5, 4.0  # of the second surface: easting, northing, height
TAGS = {"COVERAGE": "0.9", "HEIGHTS": "above the WGS 84 ellipsoid"}
RISEN, FALLEN = np.s_[40:60, 50:75], np.s_[110:125, 110:130]


def ground(east, north):
    return 12 * np.sin(east / 11) * np.cos(north / 17) + 8 * np.sin((east + north) / 29)


def write_date(path, seed, *, shift=(0, 0, 0), changes=(), tags=TAGS, first=(0, 0), crs="EPSG:32631"):
    """Heights with noise of .3 m, correlated over three cells; ``first`` cell of the grid in those of `PLACE`."""
    place = PLACE @ Affine.translation(*first[::-1])
    row, column = np.indices((SIDE, SIDE)) + 0.5
    east, north = column + first[1] - shift[0], -(row + first[0]) - shift[1]
    noise = np.random.default_rng(seed).normal(size=(SIDE + 2, SIDE + 2))
    noise = sum(noise[i : i + SIDE, j : j + SIDE] for i in range(3) for j in range(3)) / 3
    height = ground(east, north) + 0.3 * noise + shift[2]
    for part, rise in changes:
        height[part] += rise
    height[150:154, 20:30] = np.nan
    if tags is None:
        return write_raster(path, [height], place, crs)
    bands = [height, height - HALF, height + HALF, *np.ones((len(SURFACE) - 3, SIDE, SIDE))]
    return write_raster(path, bands, place, crs, tags)


@pytest.fixture(scope="module")
def dates(tmp_path_factory):
    """Folder with two dates: the second is moved, on a grid half a cell off, with two blocks of change."""
    folder = tmp_path_factory.mktemp("dates")
    write_date(folder / "before.tif", 1)
    write_date(folder / "after.tif", 2, shift=SHIFT, changes=CHANGES, first=(0.5, 0.25))
    return folder


# 1.5 m east and 2.5 m south on a grid that begins half a cell further: rows 2 and columns 1 on.
CHANGES = (
    (np.s_[RISEN[0].start + 2 : RISEN[0].stop + 2, RISEN[1].start + 1 : RISEN[1].stop + 1], 5.0),
    (np.s_[FALLEN[0].start + 2 : FALLEN[0].stop + 2, FALLEN[1].start + 1 : FALLEN[1].stop + 1], -4.0),
)


@pytest.fixture(scope="module")
def changed(dates):
    """The report of their change, with a raster of stable ground."""
    stable = np.ones((1, SIDE, SIDE))
    for part in (RISEN, FALLEN):
        grown = tuple(slice(one.start - 4, one.stop + 4) for one in part)
        stable[0][grown] = 0
    write_raster(dates / "stable.tif", stable)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registration, "_SEARCHED", 2000)
        return sat_intervals.change(
            dates / "before.tif", dates / "after.tif", dates / "out", stable=dates / "stable.tif"
        )


pytestmark = pytest.mark.usefixtures("thinned")


def test_change__finds_shift_areas_and_volumes(changed):
    found = changed["registration"]
    np.testing.assert_allclose(found["shift"], -np.array(SHIFT), atol=0.2)
    assert changed["areas"] == 2
    (gained, of_gained), (lost, of_lost), (net, of_net) = changed["volume"].values()
    assert gained == pytest.approx(20 * 25 * 5, rel=0.08)
    assert lost == pytest.approx(-15 * 20 * 4, rel=0.08)
    assert net == pytest.approx(gained + lost)
    assert 0 < max(of_gained, of_lost) < of_net < 300
    assert changed["rate"]["measured"] <= 1.3 * changed["rate"]["named"]
    assert [line for line in changed["warnings"] if "changes.gpkg" not in line] == []  # without pyogrio
    assert changed["cells"]["compared"] + changed["cells"]["undecided"] == SIDE**2


def test_change__writes_bands_that_fit_each_other(dates, changed):
    with rasterio.open(dates / "out" / "change.tif") as dataset:
        difference, lower, upper, significance, change = dataset.read()
        assert horizontal(dataset.crs) == "EPSG:32631" != dataset.crs
        assert (dataset.transform, dataset.tags()["HEIGHTS"]) == (PLACE, TAGS["HEIGHTS"])
        assert dataset.descriptions[3:] == ("significance", "change")
    known = np.isfinite(change)
    assert (np.isfinite(significance) == known).all()
    assert ((lower <= difference) & (difference <= upper))[known].all()
    assert ((significance < 0.1) == ((lower > 0) | (upper < 0)))[known].all()
    assert (change[RISEN] == 1).mean() > 0.8
    assert (change[FALLEN] == -1).mean() > 0.8
    assert np.abs(difference[RISEN][change[RISEN] == 1] - 5).mean() < 0.6
    assert json.loads((dates / "out" / "change.json").read_text()) == changed
    dataset = sat_intervals.open_surface(dates / "out" / "change.tif")
    assert (dataset.attrs["vertical_datum"], dataset["change"].shape) == ("the WGS 84 ellipsoid", (SIDE, SIDE))


def test_change__swapped_dates_give_the_opposite(dates, changed, tmp_path):
    other = sat_intervals.change(dates / "after.tif", dates / "before.tif", tmp_path / "out")
    assert other["areas"] == 2
    assert other["volume"]["gained"][0] == pytest.approx(-changed["volume"]["lost"][0], rel=0.1)
    np.testing.assert_allclose(other["registration"]["shift"], SHIFT, atol=0.2)


def test_change__takes_surfaces_of_other_tools(dates, tmp_path):
    """Heights alone with --sigma, in another CRS and with finer cells; no shift is looked for."""
    one = write_date(tmp_path / "one.tif", 5, tags=None)
    with rasterio.open(one) as source:
        from rasterio.warp import calculate_default_transform, reproject

        place, columns, rows = calculate_default_transform(source.crs, "EPSG:32630", SIDE, SIDE, *source.bounds)
        height = np.full((rows, columns), np.nan, np.float32)
        reproject(source.read(1), height, src_transform=source.transform, src_crs=source.crs, src_nodata=np.nan,
                  dst_transform=place, dst_crs="EPSG:32630", resampling=1)  # fmt: skip
    height[100:120, 100:130] += 6
    other = write_raster(tmp_path / "other.tif", [height], place, "EPSG:32630")
    with rasterio.open(other, "r+") as dataset:
        dataset.descriptions = ["elevation"]
    found = sat_intervals.change(one, other, tmp_path / "out", sigma=0.4, registers=False)
    assert found["areas"] == 1
    assert found["volume"]["gained"][0] == pytest.approx(20 * 30 * 6, rel=0.15)
    assert found["registration"] is None
    with rasterio.open(tmp_path / "with.tif", "w", driver="GTiff", height=SIDE, width=SIDE, count=2, dtype="float32",
                       crs="EPSG:32631", transform=PLACE, nodata=-9999) as dataset:  # fmt: skip
        with rasterio.open(one) as source:
            dataset.write(np.nan_to_num(source.read(1), nan=-9999), 1)
        dataset.write(np.full((SIDE, SIDE), 0.4, np.float32), 2)
        dataset.descriptions = ["dsm", "dsm_std"]
    again = sat_intervals.change(one, tmp_path / "with.tif", tmp_path / "none", sigma=0.4, registers=False)
    assert (again["areas"], again["cells"]["undecided"]) == (0, 40)


def test_change__of_no_smallest_area_keeps_the_rate(tmp_path):
    for seed in (1, 2):
        write_date(tmp_path / f"{seed}.tif", seed)
    found = sat_intervals.change(
        tmp_path / "1.tif", tmp_path / "2.tif", tmp_path / "out", registers=False, smallest_area=0
    )
    assert found["cells"]["risen"] + found["cells"]["fallen"] < 0.02 * SIDE**2


def test_change__does_not_take_filled_cells_for_measured_ones(dates, tmp_path):
    filled = shutil.copy(dates / "before.tif", tmp_path / "filled.tif")
    with rasterio.open(filled, "r+") as dataset:
        count = dataset.read(4)
        count[40:60, 40:60] = 0
        dataset.write(count, 4)
    sat_intervals.change(dates / "before.tif", filled, tmp_path / "out", registers=False)
    assert np.isnan(read_layers(tmp_path / "out" / "change.tif")[0, 41:59, 41:59]).all()


def test_change__counts_no_ground_and_unknown_sigma_as_no_data(tmp_path):
    write_date(tmp_path / "one.tif", 1)
    with rasterio.open(tmp_path / "one.tif") as source:
        height = source.read(1)
    place = {"height": SIDE, "width": SIDE, "crs": "EPSG:32631", "transform": PLACE}
    with rasterio.open(tmp_path / "two.tif", "w", driver="GTiff", count=2, dtype="float32", **place) as dataset:
        height[:3], sigma = -32768, np.full((SIDE, SIDE), 4, np.float32)
        sigma[5:7] = -9999
        dataset.write(np.stack([np.nan_to_num(height, nan=-32768), sigma]))
        dataset.scales = [1, 0.1]
        dataset.descriptions = ["dsm", "dsm_std"]
    found = sat_intervals.change(tmp_path / "one.tif", tmp_path / "two.tif", tmp_path / "out", registers=False)
    assert (found["areas"], found["cells"]["undecided"]) == (0, 40 + 5 * SIDE)


def test_areas__volumes_have_the_error_of_the_shift_on_slopes(tmp_path):
    ramp = 0.5 * np.indices((80, 80))[1].astype(float)
    for name, rise in (("before", 0), ("after", 9)):
        height = ramp.copy()
        height[20:60, 20:60] += rise
        write_surface(tmp_path / f"{name}.tif", height, height - HALF, height + HALF, TAGS)
    pair, *_ = open_pair(tmp_path / "before.tif", tmp_path / "after.tif", None, registers=False)
    found = {}
    for deviation in (0.0, 0.25):
        moved = replace(pair, shift=np.array([[0, 0, 0], [deviation, deviation, 0]]))
        signs, _ = signs_of(moved, 0.01, None)
        areas = ChangedAreas(moved, signs, 50)
        for window in moved.strips():
            areas.add(window)
        figures, found_in_all = areas.report()
        found[deviation] = float(figures["volume_deviation"][0] / figures["area"][0])
        total = found_in_all["volume"]["gained"][1]
        assert total == pytest.approx(float(figures["volume_deviation"][0]), rel=1e-6)
    assert found[0.25] > 0.12 > 3 * found[0.0]


def test_change__warns_of_intervals_that_are_too_narrow(tmp_path):
    for seed in (1, 2):
        bands = [ground(*np.indices((64, 64))) + np.random.default_rng(seed).normal(size=(64, 64))]
        write_surface(tmp_path / f"{seed}.tif", bands[0], bands[0] - 0.2, bands[0] + 0.2, TAGS)
    found = sat_intervals.change(tmp_path / "1.tif", tmp_path / "2.tif", tmp_path / "out", registers=False)
    assert "intervals are too narrow" in found["warnings"][-1]
    assert found["areas"] == 0


def test_change__refuses_in_one_line(dates, changed, tmp_path):
    before, after = dates / "before.tif", dates / "after.tif"
    refused(["change", before, after, dates / "out"], "change.tif exists", "--overwrite")
    refused(["change", before, after, tmp_path, "--false-alarms", 2], "false_alarms is 2", "between 0 and 1")
    refused(["change", before, after, tmp_path, "--smallest-area", -1], "smallest_area is -1")
    geoid = write_date(tmp_path / "geoid.tif", 1, tags=TAGS | {"HEIGHTS": "above egm.gtx"})
    refused(["change", before, geoid, tmp_path], "above egm.gtx", "--geoid")
    refused(["change", before, write_date(tmp_path / "plain.tif", 1, tags=None), tmp_path], "plain.tif", "--sigma")
    refused(["change", before, write_date(tmp_path / "alpha.tif", 1, tags={}), tmp_path], "alpha.tif", "--coverage")
    degrees = write_raster(tmp_path / "degrees.tif", np.ones((1, 9, 9)), Affine(1, 0, 0, 0, -1, 46), "EPSG:4326")
    refused(["change", before, degrees, tmp_path, "--sigma", 1], "degrees.tif", "metres")
    far = write_date(tmp_path / "far.tif", 1, first=(90_000, 0))
    refused(["change", before, far, tmp_path], "same place")
    other_side = write_date(tmp_path / "side.tif", 1, crs="EPSG:32731")
    refused(["change", before, other_side, tmp_path, "--no-register"], "same place")
    feet = write_date(tmp_path / "feet.tif", 1, crs="EPSG:2236")
    refused(["change", before, feet, tmp_path], "feet.tif is on no map in metres")
    refused(["change", before, after, tmp_path, "--sigma", 1], "both surfaces have bounds: leave sigma out")
    refused(["change", before, dates / "out" / "change.tif", tmp_path], "change.tif is a change of height")
    elsewhere = write_raster(tmp_path / "elsewhere.tif", np.ones((1, 9, 9)), PLACE @ Affine.translation(9000, 0))
    refused(["change", before, after, tmp_path / "new", "--stable", elsewhere], "elsewhere.tif has no ground that both")


@pytest.mark.peer("matplotlib")
def test_change__is_known_by_plot_report_and_project(dates, changed):
    for command, file in (("plot", "change.png"), ("report", "report.html"), ("project", "project.qgz")):
        result = invoke(command, dates / "out")
        assert result.exit_code == 0, result.output
        assert file in result.output
        assert (dates / "out" / file).stat().st_size > 1000
    page = (dates / "out" / "report.html").read_text()
    assert "data:image/png" in page
    assert "2 areas of 50 m2" in page
    refused(["plot", dates / "out", "--row", 3], "--row is for a pair", "change between two dates")


@pytest.mark.peer("pyogrio", "shapely")
def test_change__writes_polygons_and_reads_stable_ones(dates, changed, tmp_path):
    import shapely
    from pyogrio.raw import read, write

    known, _, geometry, fields = read(dates / "out" / "changes.gpkg")
    found = dict(zip(known["fields"], fields, strict=True))
    assert sorted(found["change"]) == [-1, 1]
    areas = shapely.area(shapely.from_wkb(geometry))
    np.testing.assert_allclose(areas, found["area"])
    assert found["volume"].sum() == pytest.approx(changed["volume"]["net"][0])
    assert (found["difference_lower"] < found["difference"]).all()
    assert (found["volume_deviation"] > 0).all()
    # the east half of the ground, in degrees
    with rasterio.open(dates / "before.tif") as dataset:
        west, south, east, north = dataset.bounds
    from rasterio.warp import transform_geom

    half = shapely.geometry.mapping(shapely.box((west + east) / 2, south, east, north))
    moved = shapely.geometry.shape(transform_geom("EPSG:32631", "EPSG:4326", half))
    write(tmp_path / "stable.geojson", np.array([moved.wkb], object), [], [], driver="GeoJSON",
          geometry_type="Polygon", crs="EPSG:4326")  # fmt: skip
    result = invoke("change", dates / "before.tif", dates / "after.tif", tmp_path, "--stable",
                    tmp_path / "stable.geojson", "--json")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["rate"]["stable"] == pytest.approx(SIDE**2 / 2, rel=0.05)
    assert "of the stable ground count as changed" in result.stderr or not json.loads(result.stdout)["warnings"]
