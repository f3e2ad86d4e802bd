"""Files of points: tables, Parquet and vectors say where their points are and how high, or one line what is wrong."""

import json
from contextlib import suppress

import numpy as np
import pytest

from sat_intervals import SatIntervalsError
from sat_intervals.raster import Vertical, path_of

with suppress(SatIntervalsError):  # without shareloc all tests here are skipped
    from sat_intervals.heights.point_files import PointFile
    from sat_intervals.heights.polygons import read_areas

pytestmark = pytest.mark.peer("shareloc", "pyarrow", "pyogrio", "shapely")

RANDOM = np.random.default_rng(11)
POINTS = np.column_stack([RANDOM.uniform(4, 5, 300), RANDOM.uniform(51, 52, 300), RANDOM.uniform(-5, 60, 300)])


def read(path, crs=None):
    file = PointFile(path, crs, Vertical(ellipsoid=True))
    return file.frame.crs, np.concatenate(list(file.parts()))


def write_table(path, header, form):
    path.write_text("\n".join([header, *(form(*map(repr, point)) for point in POINTS.tolist())]) + "\n")
    return path


def wkb(points):
    import shapely

    return shapely.to_wkb(shapely.points(points))


@pytest.mark.parametrize(
    ("header", "form", "crs"),
    [
        ("h_li,Latitude,Longitude", "{z},{y},{x}", None),
        ("shot;lat_lowestmode;lon_lowestmode;elev_lowestmode", "a;{y};{x};{z}", None),
        ("lon;lat;h;note", "{x};{y};{z};ä", "decimal comma"),
        ("lat\tlon\tz", "{y}\t{x}\t{z}", None),
        ("id,WKT,h_li", '7,"POINT ({x} {y})",{z}', "EPSG:4326"),
        ("geometry;h_mean", "POINT Z ({x} {y} 0);{z}", "EPSG:4326"),
        ("geom", "POINT Z ({x} {y} {z})", "EPSG:4326"),
    ],
)
def test_point_file__reads_tables_as_others_write_them(header, form, crs, tmp_path):
    has_comma = crs == "decimal comma"

    def line(x, y, z):
        text = form.format(x=x, y=y, z=z)
        return text.replace(".", ",") if has_comma else text

    found, points = read(write_table(tmp_path / "p.csv", header, line), None if has_comma else crs)
    assert found.is_geographic
    np.testing.assert_array_equal(points, POINTS)


@pytest.mark.parametrize("kind", ["columns", "geometry", "constant Z", "its CRS"])
def test_point_file__reads_parquet_with_and_without_geometry(kind, tmp_path):
    import pyarrow
    import pyproj
    from pyarrow import parquet

    place = POINTS if kind == "its CRS" else POINTS * (1, 1, 0) if kind == "constant Z" else POINTS[:, :2]
    columns = {"longitude": POINTS[:, 0], "latitude": POINTS[:, 1], "h_mean": POINTS[:, 2], "counts": [[1, 2]] * 300}
    if kind != "columns":
        columns = {"h_mean": POINTS[:, 2] + (33 if kind == "its CRS" else 0), "shape": list(wkb(place))}
    geometry = {"encoding": "WKB"} | ({"crs": pyproj.CRS(4258).to_json_dict()} if kind == "its CRS" else {})
    says = {"primary_column": "shape", "columns": {"shape": geometry}}
    table = pyarrow.table(columns).replace_schema_metadata({} if kind == "columns" else {"geo": json.dumps(says)})
    parquet.write_table(table, tmp_path / "p.parquet", row_group_size=70)
    crs, points = read(tmp_path / "p.parquet")
    assert crs.to_epsg() == {"columns": 4326, "its CRS": 4258}.get(kind)  # else OGC:CRS84
    np.testing.assert_array_equal(points, POINTS)


@pytest.mark.parametrize(("z", "taken"), [(0.0, "column"), (-3.5, "column"), ("own", "Z"), (None, "column")])
def test_point_file__a_constant_z_beside_a_column_of_heights_is_not_the_height(z, taken, tmp_path):
    import pyogrio

    points = POINTS[:, :2] if z is None else POINTS if z == "own" else np.column_stack([POINTS[:, :2], np.full(300, z)])
    kind = {"geometry_type": "Point" if z is None else "Point Z", "crs": "EPSG:4326", "driver": "GeoJSON"}
    options = {"COORDINATE_PRECISION": "15"}
    pyogrio.raw.write(tmp_path / "p.geojson", wkb(points), [POINTS[:, 2] + 20], ["h_li"], **kind, **options)
    _, found = read(tmp_path / "p.geojson")
    expected = np.add(POINTS, (0, 0, 20 if taken == "column" else 0))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_point_file__says_in_one_line_what_it_cannot_read(tmp_path):
    import pyogrio

    (tmp_path / "junk.parquet").write_text("no Parquet")
    (tmp_path / "place.csv").write_text("geometry,h\nPOINT (4 51),2\n")
    (tmp_path / "short.csv").write_text("lon,lat,h\n4,51,2\n4,51\n")
    kind = {"geometry_type": "Point", "crs": "EPSG:4326", "driver": "GPKG"}
    pyogrio.raw.write(tmp_path / "flat.gpkg", wkb(POINTS[:, :2]), [], [], **kind)
    for name, message in (
        ("junk.parquet", "junk.parquet cannot be read as points: "),
        ("place.csv", "place.csv has no CRS: give it with --crs"),
        ("short.csv", "Row #3: Expected 3 columns, got 2: 4,51: correct or convert it"),
        ("flat.gpkg", "flat.gpkg has points without heights: give 3D points, or a column named height"),
    ):
        with pytest.raises(SatIntervalsError) as error:
            read(tmp_path / name)
        assert message in str(error.value)
        assert "\n" not in str(error.value)
    for reader, name in ((read, "s3://bucket/p.csv"), (read, "https://host/p.las"), (read_areas, "s3://bucket/p.gpkg")):
        with pytest.raises(SatIntervalsError, match="is on a server: download it"):
            reader(path_of(name))


@pytest.mark.parametrize("ending", ["gpkg", "parquet", "csv"])
def test_point_file__yields_a_column_sigma_if_asked_for(ending, tmp_path):
    from pyarrow import parquet, table
    from pyogrio.raw import write

    path, sigma = tmp_path / f"p.{ending}", np.arange(300.0)
    longitude, latitude, height = POINTS.T
    if ending == "gpkg":
        write(path, wkb(POINTS), [sigma], ["Sigma"], geometry_type="Point Z", crs="EPSG:4326")
    elif ending == "parquet":
        parquet.write_table(table({"lon": longitude, "lat": latitude, "h": height, "sigma": sigma}), path)
    else:
        np.savetxt(path, np.column_stack([POINTS, sigma]), delimiter=";", header="lon;lat;h;SIGMA", comments="")
    file = PointFile(path, None, Vertical(ellipsoid=True))
    (points,) = file.parts(with_sigma=True)
    np.testing.assert_allclose(points, np.column_stack([POINTS, sigma]))
    assert next(file.parts()).shape == (300, 3)


def test_point_file__reads_no_sigma_that_is_not_asked_for(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("longitude,latitude,height,sigma\n1,2,3,fine\n4,5,6,poor\n")
    (points,) = PointFile(path, None, Vertical(ellipsoid=True)).parts()
    np.testing.assert_allclose(points, [[1, 2, 3], [4, 5, 6]])
