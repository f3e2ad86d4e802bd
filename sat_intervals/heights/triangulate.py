"""Export the points of a run, strip by strip: a GeoTIFF of longitude, latitude and heights, or a LAZ file."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.geometry import FILE, geometry_of
from sat_intervals.heights.lattice import WINDOW, Lattice, on_map
from sat_intervals.heights.point_cloud import PointCloud
from sat_intervals.products import Bands
from sat_intervals.progress import Progress
from sat_intervals.raster import Layer, OutputWriter, Projection, between_180, new_file, path_of, points_file, utm_of
from sat_intervals.results import Run, open_input, open_run
from sat_intervals.tiling import Grid, Window

_PIXELS = 1 << 18  # pixels computed at a time, 300 bytes each; pixels read ahead take 18 bytes
# Positions are rounded to 0.01 mm on the ground and 0.1 mm in height, below the error of the lattice. This halves the
# file.
_DEGREES, _METRES = 2.0**-33, 2.0**-13
_ENDINGS = ".tif", ".tiff", ".laz", ".las"
_STEP = 0.001  # metres: step of the coordinates in a LAS or LAZ file


def triangulate(
    out: str | Path | Run,
    path: str | Path | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Export the points of a run with their height bounds; an existing file is replaced.

    Parameters
    ----------
    out
        Folder of the finished run, or the run as it was opened; `set_geometry` has named its models and grids.
    path
        The file to write, by default ``points.tif`` in the folder. A name that ends with ``.laz`` or ``.las`` means
        points in the UTM zone of the run (metres, heights above the ellipsoid) with the intensity of the left image,
        and ``lower``, ``upper`` (metres) and ``confidence`` as extra dimensions. It needs laspy.
    progress
        Callback, see `Progress`.

    Returns
    -------
    ``points``, the number of points; if there are any, minimum and maximum of ``height`` (metres above the ellipsoid);
    the figures of `set_geometry`, and ``lost``, the share of the region where grids or models have no values.
    """
    run = out if isinstance(out, Run) else open_run(out)
    path = run.out / "points.tif" if path is None else path_of(path)
    if path.suffix.lower() not in _ENDINGS:
        raise SatIntervalsError(f"{path}: give a name that ends with {', '.join(_ENDINGS)}")
    geometry = geometry_of(run, progress)
    run.check_kept([path], [run.out / FILE, *geometry.files])
    write = _write_las if path.suffix.lower() in (".laz", ".las") else _write_raster
    tally = _PointCounts()
    write(run, geometry.lattice, path, tally, progress)
    return tally.report() | geometry.report


def _write_raster(run: Run, lattice: Lattice, path: Path, tally: "_PointCounts", progress: Progress) -> None:
    with OutputWriter(path.parent, [points_file(path.name)], *run.shape, run.georeferencing, {}) as writer:
        for window, bands in _strips(run):
            layers = _layers(lattice, window, np.where(bands.valid, bands[:3], np.float32(np.nan)))
            writer.write(window.row, layers)
            tally.add(layers[2])
            progress("points", window.row_stop, run.shape[0])
        progress("files", 0, 1)
        writer.publish()
        progress("files", 1, 1)


def _write_las(run: Run, lattice: Lattice, path: Path, tally: "_PointCounts", progress: Progress) -> None:
    try:
        import laspy
    except ModuleNotFoundError as error:
        raise SatIntervalsError(f"{path} needs laspy: pip install 'sat-intervals[reference]'") from error
    projection = Projection(utm_of(*lattice.middle))
    lattice = on_map(lattice, projection, str(run.out))
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, _STEP), np.floor(np.nanmin(lattice.nodes, axis=(0, 1, 2)))
    header.add_crs(projection.definition.to_3d())  # whose heights are above the ellipsoid
    for name, meaning in (("lower", "height bound, metres"), ("upper", "height bound, metres"), ("confidence", "")):
        header.add_extra_dim(laspy.ExtraBytesParams(name, "float32", meaning))
    left = Layer(open_input(run.report["inputs"]["left"]), run.region.row, run.region.column)
    cloud = PointCloud(run, lattice, SurfaceChoices(keeps_open=True, keeps_border=True))
    kind = {"header": header, "do_compress": path.suffix.lower() == ".laz"}
    with new_file(path) as temporary, _disk_errors(), laspy.open(temporary, "w", **kind) as file:
        for tile in Grid(Window(0, 0, *run.shape), WINDOW):
            window = tile.core
            points, _ = cloud.points(window)
            known = np.isfinite(points.height)
            record = laspy.ScaleAwarePointRecord.zeros(int(known.sum()), header=header)
            record.x, record.y, record.z = (values[known] for values in points[:3])
            record.intensity = np.clip(np.nan_to_num(left.read(window)[known]), 0, 65535).astype(np.uint16)
            for name in ("lower", "upper", "confidence"):
                record[name] = getattr(points, name)[known]
            record.return_number[:] = record.number_of_returns[:] = 1
            file.write_points(record)
            tally.add(points.height)
            progress("points", window.row_stop, run.shape[0])


@contextmanager
def _disk_errors() -> Iterator[None]:
    """Turn errors of the compressor, which writes itself, into those of the system."""
    import lazrs

    try:
        yield
    except lazrs.LazrsError as error:
        raise OSError(str(error)) from error


class _PointCounts:
    """Count points, and keep the lowest and the highest."""

    def __init__(self) -> None:
        self._points, self._lowest, self._highest = 0, np.inf, -np.inf

    def add(self, height: np.ndarray) -> None:
        known = height[np.isfinite(height)]
        self._points += known.size
        self._lowest = min(self._lowest, known.min(initial=np.inf))
        self._highest = max(self._highest, known.max(initial=-np.inf))

    def report(self) -> dict[str, Any]:
        ends = {"height": (float(self._lowest), float(self._highest))} if self._points else {}
        return {"points": self._points, **ends}


def _strips(run: Run) -> Iterator[tuple[Window, Bands]]:
    """Yield windows of whole rows with their bands."""
    height = max(1, _PIXELS // run.region.width)
    for block in run.windows():
        bands = run.read_bands(block)
        for first in range(0, block.height, height):
            part = Bands(*(band[first : first + height] for band in bands[:5]))
            yield Window(block.row + first, 0, len(part.disparity), block.width), part


def _layers(lattice: Lattice, window: Window, disparities: np.ndarray) -> np.ndarray:
    """Return the bands of ``points.tif`` for disparity, lower and upper ``(3, rows, columns)`` of a window."""
    middle, one, other = (lattice.points(window, disparity) for disparity in disparities)
    # Which bound gives the higher point depends on the geometry of the pair.
    low, high = np.where(one[2] > other[2], [other, one], [one, other])
    for points in (middle, low, high):
        points[0] = between_180(points[0])
    return np.stack(
        [
            *_rounded(middle[:2], _DEGREES),
            *_rounded((middle[2], low[2], high[2]), _METRES),
            middle[3].astype(np.float32),
            *_rounded((*low[:2], *high[:2]), _DEGREES),
        ]
    )


def _rounded(bands: Iterable[np.ndarray], step: float) -> Iterator[np.ndarray]:
    return (np.rint(band / step) * step for band in bands)
