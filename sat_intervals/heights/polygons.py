"""Read areas of the map from rasters and polygons, and write polygons; pyogrio has GeoPackage, GeoJSON, shapefiles."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from sat_intervals.errors import SatIntervalsError, check_file
from sat_intervals.heights.point_files import check_here, reading
from sat_intervals.raster import Georeferencing
from sat_intervals.raster.polygons import Areas, Polygon, areas_of_raster
from sat_intervals.raster.publishing import write_file

_POLYGON = 3  # type of shapely
_VECTORS = ".gpkg", ".geojson", ".json", ".shp", ".fgb", ".parquet"


def write_polygons(
    path: Path, polygons: Sequence[Polygon], fields: Mapping[str, np.ndarray], place: Georeferencing
) -> None:
    """Write a GeoPackage of polygons in the CRS of a place; an existing file is replaced."""
    import shapely
    from pyogrio.raw import write

    assert place.crs is not None
    geometry = np.array([shapely.to_wkb(shapely.geometry.shape(polygon)) for polygon in polygons], object)
    content = BytesIO()
    write(content, geometry, [*fields.values()], [*fields], layer=path.stem, driver="GPKG", geometry_type="Polygon",
          crs=place.crs.to_wkt())  # fmt: skip
    write_file(path, content.getvalue())


def read_areas(path: Path) -> Areas:
    """Read polygons, or a raster that is not 0 in areas."""
    is_raster, remedy = path.suffix.lower() not in _VECTORS, "give a raster or a file of polygons"
    if is_raster:
        check_file(path, remedy)
        return areas_of_raster(path)
    check_here(path, remedy)
    with reading(path, "polygons"):
        import shapely
        from pyogrio.raw import read

        known, _, geometry, _ = read(path, columns=[])
        found = shapely.get_parts(shapely.force_2d(shapely.from_wkb(geometry)))  # each lake has its own height
        found = found[(shapely.get_type_id(found) == _POLYGON) & ~shapely.is_empty(found)]
        polygons = [shapely.geometry.mapping(one) for one in found]
    if not known["crs"]:
        raise SatIntervalsError(f"{path} has no CRS: declare it, such as with ogr2ogr -a_srs EPSG:32637")
    return Areas(path, known["crs"], polygons)
