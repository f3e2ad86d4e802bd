"""Read and write files of polygons with pyogrio: GeoPackage, GeoJSON, shapefiles."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.point_files import reading
from sat_intervals.raster import Georeferencing
from sat_intervals.raster.polygons import Polygon
from sat_intervals.raster.publishing import write_file

_POLYGONS = 3, 6  # types of shapely


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


def read_polygons(path: Path) -> tuple[str, list[Polygon]]:
    """Return the CRS of a file and its polygons."""
    with reading(path, "polygons"):
        import shapely
        from pyogrio.raw import read

        known, _, geometry, _ = read(path, columns=[])
        found = shapely.from_wkb(geometry)
        polygons = [shapely.geometry.mapping(one) for one in found[np.isin(shapely.get_type_id(found), _POLYGONS)]]
    if not known["crs"]:
        raise SatIntervalsError(f"{path} has no CRS: declare it, such as with ogr2ogr -a_srs EPSG:32637")
    return known["crs"], polygons
