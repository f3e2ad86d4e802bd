"""The outline of a raster on the Earth."""

from pyproj import Transformer

from sat_intervals.raster.georeferencing import Georeferencing

Corners = list[tuple[float, float]]


def footprint(place: Georeferencing, shape: tuple[int, int]) -> Corners | None:
    """Return longitude and latitude (degrees, WGS 84) of four corners, counter-clockwise.

    Of an image with RPCs alone: the corners of the box for which they are valid, which is larger than the image.

    Returns
    -------
    None without georeferencing.
    """
    height, width = shape
    if place.crs is not None and place.transform is not None:
        a, b, c, d, e, f = place.transform[:6]
        ends = ((0, height), (width, height), (width, 0), (0, 0))
        corners = [(a * x + b * y + c, d * x + e * y + f) for x, y in ends]
        crs = place.crs
    elif place.gcps and place.gcps_crs:
        corners = _box([point.x for point in place.gcps], [point.y for point in place.gcps])
        crs = place.gcps_crs
    elif place.rpcs is not None:
        rpcs = place.rpcs
        return _box(
            [rpcs.long_off - rpcs.long_scale, rpcs.long_off + rpcs.long_scale],
            [rpcs.lat_off - rpcs.lat_scale, rpcs.lat_off + rpcs.lat_scale],
        )
    else:
        return None
    to_degrees = Transformer.from_crs(crs.to_wkt(), "EPSG:4326", always_xy=True)
    found = [to_degrees.transform(x, y) for x, y in corners]
    area = sum(x * v - u * y for (x, y), (u, v) in zip(found, found[1:] + found[:1], strict=True))
    return found if area > 0 else found[::-1]


def _box(x: list[float], y: list[float]) -> Corners:
    return [(min(x), min(y)), (max(x), min(y)), (max(x), max(y)), (min(x), max(y))]
