"""Vertical CRS of files of heights: keys of a GeoTIFF, which GDAL reads, but does not write above the ellipsoid."""

from pathlib import Path

import numpy as np
import pyproj
from rasterio.crs import CRS

from sat_intervals.raster.georeferencing import horizontal_name
from sat_intervals.raster.images import opened

# Vertical CRS of the geoids of the whole Earth, by a part of the name of their grids.
_GEOIDS = {"egm84": 5798, "egm96": 5773, "egm08": 3855, "egm2008": 3855}
# Keys of a vertical CRS: its code, name, datum and unit; the code of one that is defined by them, and of the metre.
_CODE, _NAME, _DATUM, _UNIT = 4096, 4097, 4098, 4099
_OWN, _METRE = 32767, 9001


def horizontal(crs: CRS | None) -> CRS | None:
    """Return the horizontal part of a CRS that has heights; others as they are."""
    if crs is None or len(pyproj.CRS.from_wkt(crs.to_wkt()).axis_info) < 3:
        return crs
    return CRS.from_user_input(horizontal_name(crs))


def with_vertical(crs: CRS, level: str, keys: bytes, texts: bytes) -> tuple[bytes, bytes]:
    """Return the tags GeoKeyDirectory and GeoAsciiParams of a horizontal CRS with those of heights of tag HEIGHTS."""
    rows = np.frombuffer(keys, "<u2").reshape(-1, 4)[1:].tolist()
    grid = Path(level.removeprefix("above "))
    code = _ellipsoid_code(crs) if level.endswith("ellipsoid") else _geoid_code(grid)
    rows.append([_CODE, 0, 1, code or _OWN])
    if not code:
        texts, name = texts.rstrip(b"\0"), f"heights above {grid.name}|".encode("ascii", "replace")
        rows += [[_NAME, 34737, len(name), len(texts)], [_DATUM, 0, 1, _OWN], [_UNIT, 0, 1, _METRE]]
        texts += name + b"\0"
    return np.array([[1, 1, 1, len(rows)], *rows], "<u2").tobytes(), texts


def _ellipsoid_code(crs: CRS) -> int:
    """Return the code of the geographic CRS with heights below a CRS, which stands for them in GeoTIFF 1.1, or 0."""
    base = pyproj.CRS.from_wkt(crs.to_wkt()).geodetic_crs
    return (base and base.to_3d().to_epsg()) or 0


def _geoid_code(grid: Path) -> int:
    """Return the EPSG code of the vertical CRS of a geoid grid, by its name or as PROJ's GeoTIFFs say; 0 without."""
    if code := next((code for name, code in _GEOIDS.items() if name in grid.name.lower()), 0):
        return code
    if grid.suffix.lower() in (".tif", ".tiff") and grid.exists():
        with opened(str(grid)) as dataset:
            return int(dataset.tags().get("target_crs_epsg_code", 0))
    return 0
