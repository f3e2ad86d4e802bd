"""Read points with heights in parts: CSV and Parquet (pyarrow), vector files (pyogrio), LAS and LAZ (laspy)."""

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError, check_file
from sat_intervals.raster import Frame, Vertical, is_ground

_PART = 500_000  # points read at a time
# Names of columns, in lower case; the first found counts. Those of ICESat-2 and GEDI products are among them.
_DEGREES = (("longitude", "lon", "long", "lon_lowestmode"), ("latitude", "lat", "lat_lowestmode"))
_METRES = (("x", "easting", "east"), ("y", "northing", "north"))
_HEIGHTS = (
    "height", "h", "z", "elevation", "ellipsoidal_height", "h_mean", "h_te_best_fit", "h_te_median", "h_ph", "h_li",
    "elev_lowestmode", "elevation_lm")  # fmt: skip
_GEOMETRIES = "wkt", "geometry", "geom", "the_geom"
ENDINGS = (".csv", ".parquet", ".geoparquet", ".pq", ".las", ".laz", ".gpkg", ".geojson", ".shp", ".fgb")
"""Names of files of points end so; other vectors of GDAL are read, too."""
_NOISE = 7, 18  # classes of LAS points that are noise


class PointFile:
    """Points of a CSV file with a header, Parquet, LAS, LAZ, or vectors of GDAL; ``crs`` replaces that of the file.

    ``surface``: CRS of a file without one, and what heights of a surface refer to that the points are compared with.
    """

    def __init__(
        self, path: Path, crs: str | None, vertical: Vertical, surface: tuple[str | None, str] = (None, "")
    ) -> None:
        check_here(path, "give a file of points")
        self._path, ending = path, path.suffix.lower()
        is_cloud = ending in (".las", ".laz")
        crs_of = _crs_of_las if is_cloud else _crs_of_table
        self._parts = _las if is_cloud else _of_table
        with reading(path):
            own = crs_of(path)
        self.frame = Frame(str(path), crs or own or surface[0], vertical, surface[1])

    def parts(self, *, with_sigma: bool = False) -> Iterator[np.ndarray]:
        """Yield ``(n, 3)`` float64 x, y and height in the frame, of points that have all and are on the ground.

        A fourth column, if asked for, has the column ``sigma`` of a table, NaN without.
        """
        with reading(self._path):
            for part in self._parts(self._path, with_sigma):
                # other heights are no-data values
                places = part[:, :3]
                known = np.isfinite(places).all(axis=1) & is_ground(places[:, 2] * self.frame.unit)
                yield part[known] if with_sigma else places[known]


def check_here(path: Path, remedy: str) -> None:
    """Raise if a file that is read from disks only is missing, or on a server."""
    if re.match(r"\w+:/|/vsicurl/", str(path)):
        raise SatIntervalsError(f"{path} is on a server: download it")
    check_file(path, remedy)


@contextmanager
def reading(path: Path, what: str = "points") -> Iterator[None]:
    """Turn the errors of the libraries, which are of many types, into one with the name of the file."""
    try:
        yield
    except SatIntervalsError:
        raise
    except ModuleNotFoundError as error:
        raise SatIntervalsError(f"{path} needs {error.name}: pip install 'sat-intervals[reference]'") from error
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SatIntervalsError(f"{path} cannot be read as {what}: {reason}: correct or convert it") from error


@contextmanager
def _table(path: Path, columns: Sequence[str] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield names of columns, that of the geometry and the CRS, if a file says so, and Arrow's batches of columns."""
    ending, chosen = path.suffix.lower(), list(columns) or None
    if ending == ".csv":
        with _csv(path, chosen) as batches:
            yield batches.schema.names, None, None, batches
    elif ending in (".parquet", ".geoparquet", ".pq"):
        from pyarrow.parquet import ParquetFile

        file = ParquetFile(path)
        known = json.loads((file.schema_arrow.metadata or {}).get(b"geo", "{}"))
        geometry = known.get("primary_column")
        crs = known["columns"][geometry].get("crs", "OGC:CRS84") if known else None
        crs = json.dumps(crs) if isinstance(crs, dict) else crs
        yield file.schema_arrow.names, geometry, crs, file.iter_batches(columns=chosen)
    else:
        from pyogrio.raw import open_arrow

        with open_arrow(path, use_pyarrow=True) as (known, batches):
            names = batches.schema.names
            geometry = next((name for name in (known["geometry_name"], "wkb_geometry") if name in names), None)
            yield names, geometry, known["crs"], batches


def _csv(path: Path, columns: list[str] | None) -> Any:
    """Open a table whose separator is in its first line; with semicolons, numbers may have a decimal comma."""
    from pyarrow import csv, float64

    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        first, second = stream.readline(), stream.readline()
    separator = max(",;\t", key=first.count)
    numbers = {name: float64() for name in columns or () if name.strip().lower() not in _GEOMETRIES}
    point = "," if separator == ";" and re.search(r"(^|;)\s*-?\d+,\d+\s*(;|$)", second) else "."
    options = csv.ConvertOptions(include_columns=columns, column_types=numbers, decimal_point=point)
    reading = csv.ReadOptions(use_threads=False)  # so that errors name the line
    return csv.open_csv(path, reading, csv.ParseOptions(delimiter=separator), options)


def _columns(path: Path, names: list[str], geometry: str | None) -> tuple[list[str], bool]:
    """Return the columns of x, y and height, or of geometry and height if any, and whether x and y are degrees."""
    known = {name.strip().lower(): name for name in names}
    height = next((known[name] for name in _HEIGHTS if name in known), None)
    for axes, is_degrees in ((_DEGREES, True), (_METRES, False)):
        x, y = (next((known[name] for name in choices if name in known), None) for choices in axes)
        if x and y and height and not geometry:
            return [x, y, height], is_degrees
    geometry = geometry or next((known[name] for name in _GEOMETRIES if name in known), None)
    if geometry:
        return [geometry, *([height] if height else [])], False
    listed = ", ".join(names)[:200]
    raise SatIntervalsError(f"{path} has the columns {listed}: name them longitude, latitude, height, or x, y, height")


def _crs_of_table(path: Path) -> str | None:
    with _table(path) as (names, geometry, crs, _):
        return "EPSG:4326" if _columns(path, names, geometry)[1] else crs


def _of_table(path: Path, with_sigma: bool) -> Iterator[np.ndarray]:
    """Yield points and sigma; the height is that of the geometry, unless constant or missing beside one of heights."""
    with _table(path) as (names, geometry, *_):
        chosen, _ = _columns(path, names, geometry)
        noise = [name for name in names if with_sigma and name.strip().lower() == "sigma"][:1]
    uses_column = None
    with _table(path, [*chosen, *noise]) as (*_, batches):
        for batch in batches:
            values = [batch.column(name).to_numpy(zero_copy_only=False) for name in chosen]
            places = np.column_stack(values).astype(np.float64) if len(chosen) == 3 else _places(path, *values)
            if uses_column is None:  # the first batch decides for all
                uses_column = len(chosen) == 2 and np.unique(places[np.isfinite(places[:, 2]), 2]).size < 2
            if uses_column:
                places[:, 2] = values[1]
            sigma = [batch.column(name).to_numpy(zero_copy_only=False).astype(np.float64) for name in noise]
            yield np.column_stack([places, *(sigma or [np.full(len(places), np.nan)])])


def _places(path: Path, geometry: np.ndarray, heights: np.ndarray | None = None) -> np.ndarray:
    """Return ``(n, 3)`` x, y and Z of points as WKB or WKT."""
    import shapely

    is_text = any(isinstance(one, str) for one in geometry)
    points = shapely.from_wkt(geometry) if is_text else shapely.from_wkb(geometry)
    if set(np.unique(shapely.get_type_id(points))) - {-1, 0}:
        raise SatIntervalsError(f"{path} has geometries that are not points: give points")
    if heights is None and not shapely.has_z(points).any():
        raise SatIntervalsError(f"{path} has points without heights: give 3D points, or a column named height")
    return np.column_stack([shapely.get_x(points), shapely.get_y(points), shapely.get_z(points)])


def _crs_of_las(path: Path) -> str | None:
    import laspy

    with laspy.open(path) as file:
        crs = file.header.parse_crs()
    return None if crs is None else str(crs.to_wkt())


def _las(path: Path, _: bool) -> Iterator[np.ndarray]:
    """Yield points but those marked as noise or withheld; sigma is unknown."""
    import laspy

    with laspy.open(path) as file:
        for points in file.chunk_iterator(_PART):
            kept = ~np.isin(np.asarray(points.classification), _NOISE) & (np.asarray(points.withheld) == 0)
            yield np.column_stack([points.x, points.y, points.z, np.full(kept.size, np.nan)])[kept]
