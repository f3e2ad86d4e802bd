"""Read points with heights in parts: CSV, GeoPackage and other vector files (pyogrio), LAS and LAZ (laspy)."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from sat_intervals.errors import SatIntervalsError, check_file
from sat_intervals.raster import Frame, Vertical, is_ground

# Points read at a time.
_PART = 500_000
# Names of columns, in lower case; the first found counts. Those of ICESat-2 products are among them.
_DEGREES = (("longitude", "lon", "long"), ("latitude", "lat"))
_METRES = (("x", "easting", "east"), ("y", "northing", "north"))
_HEIGHTS = ("height", "h", "z", "elevation", "ellipsoidal_height", "h_mean", "h_te_best_fit", "h_te_median", "h_ph")
# Classes of LAS points that are noise.
_NOISE = 7, 18


class PointFile:
    """Points of a CSV file with a header, LAS, LAZ, or vectors that GDAL reads; ``crs`` replaces that of the file.

    Longitude and latitude of a CSV file are on the WGS 84 ellipsoid without ``crs``.
    """

    def __init__(self, path: Path, crs: str | None, vertical: Vertical) -> None:
        check_file(path, "give a file of points")
        self._path, ending = path, path.suffix.lower()
        readers = {".csv": (_crs_of_table, _table), ".las": (_crs_of_las, _las), ".laz": (_crs_of_las, _las)}
        crs_of, self._parts = readers.get(ending, (_crs_of_vectors, _vectors))
        with _reading(path):
            own = crs_of(path)
        self.frame = Frame(str(path), crs or own, vertical)

    def parts(self) -> Iterator[np.ndarray]:
        """Yield ``(n, 3)`` float64 x, y and height in the frame, of points that have all and are on the ground."""
        with _reading(self._path):
            for part in self._parts(self._path):
                # other heights are no-data values
                yield part[np.isfinite(part).all(axis=1) & is_ground(part[:, 2] * self.frame.unit)]


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn the errors of the libraries, which are of many types, into one with the name of the file."""
    try:
        yield
    except SatIntervalsError:
        raise
    except ModuleNotFoundError as error:
        raise SatIntervalsError(f"{path} needs {error.name}: pip install 'sat-intervals[reference]'") from error
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SatIntervalsError(f"{path} cannot be read as points: {reason}") from error


def _columns(path: Path, names: list[str]) -> tuple[list[int], bool]:
    """Return the columns of x, y and height in a table, and whether x and y are degrees."""
    known = [name.strip().lower() for name in names]

    def place(choices: tuple[str, ...]) -> int | None:
        return next((known.index(name) for name in choices if name in known), None)

    height = place(_HEIGHTS)
    for axes, is_degrees in ((_DEGREES, True), (_METRES, False)):
        x, y = map(place, axes)
        if x is not None and y is not None and height is not None:
            return [x, y, height], is_degrees
    raise SatIntervalsError(
        f"{path} has the columns {', '.join(names)[:200]}: name them longitude, latitude, height, or x, y, height with "
        "--crs"
    )


def _header(path: Path) -> list[str]:
    with path.open(newline="", encoding="utf-8-sig") as stream:
        return next(csv.reader(stream), [])


def _crs_of_table(path: Path) -> str | None:
    return "EPSG:4326" if _columns(path, _header(path))[1] else None


def _table(path: Path) -> Iterator[np.ndarray]:
    chosen, _ = _columns(path, _header(path))
    with path.open(newline="", encoding="utf-8-sig") as stream:
        lines = csv.reader(stream)
        next(lines)
        part: list[list[float]] = []
        for line in lines:
            if line:
                part.append([_number(path, lines.line_num, line, place) for place in chosen])
            if len(part) == _PART:
                yield np.array(part)
                part = []
        if part:
            yield np.array(part)


def _number(path: Path, line: int, cells: list[str], place: int) -> float:
    try:
        return float(cells[place]) if cells[place].strip() else float("nan")
    except (ValueError, IndexError) as error:
        cell = cells[place] if place < len(cells) else "nothing"
        raise SatIntervalsError(f"{path}, line {line}: {cell!r} is not a number: fix this line") from error


def _crs_of_las(path: Path) -> str | None:
    import laspy

    with laspy.open(path) as file:
        crs = file.header.parse_crs()
    return None if crs is None else str(crs.to_wkt())


def _las(path: Path) -> Iterator[np.ndarray]:
    """Yield points but those marked as noise or withheld."""
    import laspy

    with laspy.open(path) as file:
        for points in file.chunk_iterator(_PART):
            kept = ~np.isin(np.asarray(points.classification), _NOISE) & (np.asarray(points.withheld) == 0)
            yield np.column_stack([points.x, points.y, points.z])[kept]


def _crs_of_vectors(path: Path) -> str | None:
    import pyogrio

    crs = pyogrio.read_info(path)["crs"]
    return None if crs is None else str(crs)


def _vectors(path: Path) -> Iterator[np.ndarray]:
    """Yield points of the first layer; the height is that of the geometry, else a column."""
    import pyogrio
    import shapely

    fields = [str(name) for name in pyogrio.read_info(path)["fields"]]
    column = next((name for choice in _HEIGHTS for name in fields if name.lower() == choice), None)
    skipped = 0
    while True:
        _, _, geometry, values = pyogrio.raw.read(
            path, columns=[column] if column else [], skip_features=skipped, max_features=_PART
        )
        if not len(geometry):
            return
        skipped += len(geometry)
        points = shapely.from_wkb(geometry)
        if set(np.unique(shapely.get_type_id(points))) - {-1, 0}:
            raise SatIntervalsError(f"{path} has geometries that are not points: give points")
        places = np.column_stack([shapely.get_x(points), shapely.get_y(points), shapely.get_z(points)])
        if column and not np.isfinite(places[:, 2]).any():
            places[:, 2] = values[0]
        elif not column and not shapely.has_z(points).any():
            raise SatIntervalsError(f"{path} has points without heights: give 3D points, or a column named height")
        yield places
