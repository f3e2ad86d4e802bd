"""Surfaces that are completed: voids filled, areas of one height, areas without data."""

import json
import shutil

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_array_equal
from surfaces import PLACE, write_raster, write_surface

from sat_intervals import SatIntervalsError
from sat_intervals.heights.choices import SurfaceChoices, completion_of
from sat_intervals.products import SURFACE
from sat_intervals.raster import completion, read_layers, read_place, surface_file

SIDE = 90
COUNT = [band.name for band in SURFACE].index("count")
LAKE, CLOUD, VOID = np.s_[20:50, 60:80], np.s_[60:70, 10:20], np.s_[5:14, 10:30]


@pytest.fixture
def scene(tmp_path):
    """The file of a slope with noise and one void, and its height."""
    random = np.random.default_rng(2)
    height = 100 + 0.1 * np.indices((SIDE, SIDE))[1] + random.normal(0, 0.05, (SIDE, SIDE))
    height[LAKE] = random.uniform(90, 120, height[LAKE].shape)
    height[VOID] = np.nan
    half = random.uniform(0.2, 0.6, height.shape)
    path = write_surface(tmp_path / "measured.tif", height, height - half, height + half)
    with rasterio.open(path, "r+") as dataset:
        dataset.write(np.where(np.isnan(height), np.nan, 7).astype(np.float32), COUNT + 1)
    return path, height


def areas(path, *parts):
    inside = np.zeros((1, SIDE, SIDE))
    for part in parts:
        inside[0][part] = 1
    return write_raster(path, inside)


def completed(scene, **options):
    """Bands of the completed surface, and the report."""
    path, _ = scene
    there = shutil.copy(path, path.with_name("dsm.tif"))
    shape, place = read_place(there)
    how = completion_of(1.0, SurfaceChoices(**options)).on(place, shape)
    report = completion.complete(there, there, surface_file("dsm.tif"), how, lambda *_: None)
    return read_layers(there), report


def test_complete__fills_voids_and_changes_nothing_else(scene):
    bands, report = completed(scene, fill=20.0)
    measured = read_layers(scene[0])
    known = np.isfinite(measured[0])
    assert_array_equal(bands[:, known], measured[:, known])
    assert np.isfinite(bands[:5]).all()
    assert_array_equal(bands[COUNT] == 0, ~known)
    assert np.abs(bands[0] - 100 - 0.1 * np.indices((SIDE, SIDE))[1])[VOID].max() < 0.2
    half = (measured[2] - measured[1])[known].min() / 2
    assert ((bands[2] - bands[0])[VOID] >= half - 1e-5).all()
    assert report == {"filled": 180, "flattened": 0, "masked": 0, "voids": 0, "areas": 0, "without_rim": 0}


def test_complete__gives_an_area_the_height_of_a_low_part_of_its_rim(scene, tmp_path):
    hidden = np.s_[9:10, 15:20]  # in the void: no rim
    bands, report = completed(scene, flatten=areas(tmp_path / "lake.tif", LAKE, hidden))
    height, lower, upper = bands[:3, 20, 60]
    assert (bands[:3][:, LAKE[0], LAKE[1]] == bands[:3, 20:21, 60:61]).all()
    rim = scene[1][17:53, 57:83]
    assert 100 + 0.1 * 57 - 0.2 < height < np.median(rim[:3])
    assert lower < height - 0.2
    assert height + 0.2 < upper
    assert np.isnan(bands[0][hidden]).all()
    assert {"flattened": 600, "areas": 2, "without_rim": 1}.items() <= report.items()


def test_complete__leaves_masked_cells_without_data_and_takes_no_height_from_them(scene, tmp_path):
    beside = np.s_[1:5, 8:32]  # of the void
    scene[1][beside] = 500
    mask = areas(tmp_path / "mask.tif", CLOUD, beside)
    bands, report = completed(scene, fill=20.0, mask=mask)
    assert np.isnan(bands[:, CLOUD[0], CLOUD[1]]).all()
    assert np.isnan(bands[0][beside]).all()
    assert np.nanmax(bands[0][VOID]) < 110
    assert report["masked"] == 100 + 96


def test_complete__is_the_same_for_any_tiles(scene, tmp_path, monkeypatch):
    lake, mask = areas(tmp_path / "lake.tif", LAKE), areas(tmp_path / "mask.tif", CLOUD)
    whole = completed(scene, fill=9.0, flatten=lake, mask=mask)
    for name, value in (("_TILE", 17), ("_CELLS", 1), ("_LOWEST", 13)):
        monkeypatch.setattr(completion, name, value)
    tiled = completed(scene, fill=9.0, flatten=lake, mask=mask)
    assert_array_equal(tiled[0], whole[0])
    assert tiled[1] == whole[1]


def test_complete__is_without_bounds_where_the_rim_has_none(tmp_path):
    height = np.full((30, 30), 5.0)
    height[10:14, 10:14] = np.nan
    path = write_surface(tmp_path / "measured.tif", height, height + np.nan, height + np.nan)
    bands, _ = completed((path, height), fill=10.0)
    assert (bands[0][10:14, 10:14] == 5).all()
    assert np.isnan(bands[1:3]).all()


@pytest.mark.peer("pyogrio", "shapely")
def test_read_areas__polygons_in_degrees_are_those_of_a_raster(scene, tmp_path):
    from pyogrio.raw import write
    from rasterio.warp import transform_geom
    from shapely.geometry import shape

    left, top = PLACE @ (60, 20)
    ring = [[left, top], [left + 20, top], [left + 20, top - 30], [left, top - 30], [left, top]]
    polygon = {"type": "Polygon", "coordinates": [ring]}
    degrees = shape(transform_geom("EPSG:32631", "EPSG:4326", polygon)).wkb
    file = tmp_path / "lake.geojson"
    write(file, np.array([degrees], object), [], [], driver="GeoJSON", geometry_type="Polygon", crs="EPSG:4326")
    of_polygons, of_raster = (completed(scene, flatten=one)[0] for one in (file, areas(tmp_path / "lake.tif", LAKE)))
    assert np.isclose(of_polygons[0], of_raster[0], rtol=0, atol=0.3, equal_nan=True).mean() > 0.99


@pytest.mark.peer("pyogrio", "shapely")
def test_read_areas__each_part_is_an_area_and_those_of_other_places_do_not_matter(scene, tmp_path):
    from pyogrio.raw import write
    from shapely import box, multipolygons, to_wkb
    from shapely.geometry import Polygon

    west, east = (box(left, top - 9, left + 9, top) for left, top in (PLACE @ (15, 60), PLACE @ (65, 60)))
    far = box(500_000, 0, 500_009, 9_000_000)
    shapes = np.array([to_wkb(one) for one in (multipolygons([west, east]), far, Polygon())], object)
    file = tmp_path / "lakes.gpkg"
    write(file, shapes, [], [], driver="GPKG", geometry_type="Unknown", crs="EPSG:32631")
    bands, report = completed(scene, flatten=file)
    assert {"areas": 2, "without_rim": 0}.items() <= report.items()
    assert bands[0, 65, 70] - bands[0, 65, 20] > 3  # the slope is .1


def test_completion__refuses_what_it_cannot_use(scene, tmp_path, caplog):
    with pytest.raises(SatIntervalsError, match=r"fill distance is 500 m: give 2 to 256 m, 2 to 256 cells"):
        completed(scene, fill=500.0)
    with pytest.raises(SatIntervalsError, match=r"none.tif: no such file"):
        completed(scene, mask=tmp_path / "none.tif")
    far = write_raster(tmp_path / "far.tif", np.ones((1, 9, 9)), PLACE @ PLACE.translation(9000, 0))
    bands, report = completed(scene, mask=far)  # one file for many places
    assert report["masked"] == 0
    assert "far.tif has no area on the surface: check its CRS" in caplog.text
    assert_array_equal(bands, read_layers(scene[0]))
    (tmp_path / "broken.geojson").write_text(json.dumps({"type": "Nothing"}))
    with pytest.raises(SatIntervalsError, match=r"broken.geojson (cannot be read as polygons|needs)"):
        completed(scene, flatten=tmp_path / "broken.geojson")
