"""Epipolar grids of a raw pair: where it overlaps, at which height, how large pixels are, and the grids of shareloc."""

import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError, check_file
from sat_intervals.heights.models import SensorImage, common_heights, common_parts, read_with
from sat_intervals.kernels.compiled import kernels_of_others
from sat_intervals.raster import Georeferencing, ground_of, path_of, write_layer
from sat_intervals.tiling import Window

with kernels_of_others():
    from affine import Affine
    from scipy.interpolate import RectBivariateSpline
    from shareloc.dtm_reader import dtm_reader
    from shareloc.geofunctions.dtm_intersection import DTMIntersection
    from shareloc.geofunctions.rectification import compute_stereorectification_epipolar_grids
    from shareloc.proj_utils import coordinates_conversion

STEP, MARGIN = 30, 2  # pixels between nodes, and nodes beyond the images, as in CARS
_BEYOND = 60  # pixels around the overlap, for ground that is higher or lower than the height of the grids
_AS_GOOD = 0.99  # share of the largest overlap that is as good
_MUCH = 0.8  # share of the largest overlap below which a given altitude is doubted
_EQUAL = 1.1  # ratio of pixel sizes up to which they are equal: the cubic then needs no smoothing
# Base-to-height ratio below which a pixel of disparity is more than 25 m in an image of .5 m.
_LEAST_BASE = 0.02
_FEW = 100  # nodes along an image, at least, between which positions at one height are smooth
_AROUND = 0.02  # degrees of a DEM around the nodes, for ground that is higher or lower

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Terrain:
    """The height at which disparities are 0: a DEM, above a geoid or the ellipsoid, or metres; by default found."""

    dem: Path | None = None
    altitude: float | None = None
    geoid: Path | None = None

    def check(self) -> None:
        """Raise for what does not go together, or is missing."""
        if self.dem and self.altitude is not None:
            raise SatIntervalsError(f"the DEM {self.dem} and an altitude of {self.altitude:g} m are given: give one")
        if self.geoid and not self.dem:
            raise SatIntervalsError(f"the geoid {self.geoid} is given without a DEM: leave it out, or give a DEM")
        for file in filter(None, (self.dem, self.geoid)):
            check_file(file, "give a raster of heights")


@dataclass(frozen=True)
class Epipolar:
    """Grids of a pair and their figures.

    Attributes
    ----------
    left, right
        ``(n, m, 2)`` float64, row and column of the nodes in the whole sensor images (first pixel centre at 0.5).
    height, width
        Size of both epipolar images; the first pixel is `MARGIN` nodes from the first node.
    scales
        Sensor pixels per epipolar pixel of the left and the right image, 1 if they are nearly as large.
    figures
        ``altitude`` (metres, None with a DEM), ``overlap`` (share of the left image), ``pixel_size`` (metres),
        ``base_to_height``, ``metres_per_disparity``, ``footprint`` (longitude and latitude of the corners).
    """

    left: np.ndarray
    right: np.ndarray
    height: int
    width: int
    scales: tuple[float, float]
    figures: dict[str, Any]

    def middle(self, side: int) -> "Epipolar":
        """Return the grids of the part in the middle, as high and wide as a multiple of nodes below ``side``."""
        height, width = (min(size, side // STEP * STEP) for size in (self.height, self.width))
        row, column = (self.height - height) // 2 // STEP, (self.width - width) // 2 // STEP
        rows, columns = -(-height // STEP) + 2 * MARGIN + 1, -(-width // STEP) + 2 * MARGIN + 1
        left, right = (nodes[row : row + rows, column : column + columns] for nodes in (self.left, self.right))
        return Epipolar(left, right, height, width, self.scales, self.figures)


def grid_place() -> Georeferencing:
    """Return the georeferencing of the files of grids: epipolar positions of their cells' centres."""
    first = -(MARGIN + 0.5) * STEP
    return Georeferencing(transform=Affine(STEP, 0, first, 0, STEP, first))


def epipolar_geometry(
    left: SensorImage, right: SensorImage, terrain: Terrain, resolution_of: str, ground: tuple[float, int] | None = None
) -> Epipolar:
    """Return the grids of the overlap of a raw pair on the ground, see `ground_of`; raise without overlap or base."""
    height, reach = ground or (likely_height(left, right) if terrain.altitude is None else terrain.altitude, 0)
    for one in (left, right):
        one.check_height(height)
    share, parts = _overlap(left, right, height, reach, f"at {height:.0f} m above the ellipsoid")
    if terrain.altitude is not None:
        likely = likely_height(left, right)
        larger = float(common_parts(left, right, likely, _BEYOND)[0][0])
        if share < _MUCH * larger:
            _LOG.warning(
                "at %g m the images overlap by %.0f %%, at %.0f m by %.0f %%: check --altitude",
                *(height, 100 * share, likely, 100 * larger),
            )
    sizes = [_pixel_size(one, part, height) for one, part in zip((left, right), parts, strict=True)]
    ratio = sizes[1] / sizes[0]
    spacing = ratio if resolution_of == "coarser" and ratio > _EQUAL else 1.0
    nodes, shape, base = _few_nodes((left, right), parts, height, spacing)
    if terrain.dem:
        elevation = _dem(left, right, nodes[0], terrain, height)
        share, parts = _overlap(left, right, elevation, reach, f"on {terrain.dem}")
        nodes, shape, base = shareloc_grids((left, right), parts, elevation, spacing)
    if not np.isfinite([base, *map(np.sum, nodes)]).all():
        raise SatIntervalsError(f"{terrain.dem} does not cover the epipolar images: give a larger DEM")
    base_to_height = base * sizes[0]
    if not base_to_height >= _LEAST_BASE:
        raise SatIntervalsError(
            f"{left.image.path} and {right.image.path} have a base-to-height ratio of {base_to_height:.3f}: heights "
            f"need at least {_LEAST_BASE:g}: give another pair"
        )
    if terrain.altitude is None and not (ground or terrain.dem):
        _LOG.warning("no height of the ground is found: disparity 0 at %.0f m: give --altitude if it is known", height)
    left_scale, right_scale = (scale if scale > _EQUAL else 1.0 for scale in (spacing, spacing / ratio))
    figures = {
        "altitude": None if terrain.dem else round(height, 3),
        "overlap": round(share, 4),
        "pixel_size": round(spacing * sizes[0], 4),
        "base_to_height": round(base_to_height, 4),
        "metres_per_disparity": round(-spacing / base, 4),
        "footprint": _footprint(left, nodes[0], shape, height),
    }
    return Epipolar(*nodes, *shape, (left_scale, right_scale), figures)


def _overlap(
    left: SensorImage, right: SensorImage, elevation: Any, reach: int, where: str
) -> tuple[float, tuple[Window, Window]]:
    """Return share and parts of the overlap, see `common_parts`; raise if there is none."""
    shares, parts = common_parts(left, right, elevation, max(_BEYOND, reach))
    if parts is None:
        raise SatIntervalsError(
            f"{left.image.path} and {right.image.path} do not overlap {where}: give images of one place, their models, "
            "or another --altitude"
        )
    return float(shares[0]), parts


def likely_height(left: SensorImage, right: SensorImage) -> float:
    """Return the height in the domain of both models at which most of the left image is on the right one."""
    heights = common_heights(left, right)
    shares, _ = common_parts(left, right, heights, 0)
    return float(heights[shares >= _AS_GOOD * shares.max()].mean())


def _few_nodes(
    images: tuple[SensorImage, SensorImage], parts: tuple[Window, Window], height: float, spacing: float
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[int, int], float]:
    """Return `shareloc_grids` at one height, of large images by splines between few nodes.

    Rows of a pair of 30 000 x 38 000 px are then 0.0007 px apart at most, in a second instead of a quarter of an hour.
    """
    step = STEP * max(1, max(parts[0].height, parts[0].width) // (_FEW * STEP))
    nodes, shape, base = shareloc_grids(images, parts, height, spacing, step)
    if step == STEP:
        return nodes, shape, base
    known = [step * (np.arange(count) - _margin(step)) for count in nodes[0].shape[:2]]
    wanted = [STEP * np.arange(-MARGIN, -(-size // STEP) + MARGIN + 1) for size in shape]
    left, right = (
        np.stack([RectBivariateSpline(*known, one[..., axis])(*wanted) for axis in (0, 1)], axis=-1) for one in nodes
    )
    return (left, right), shape, base


def _margin(step: int) -> int:
    """Return the nodes beyond the images of grids with a step."""
    return -(-MARGIN * STEP // step)


def shareloc_grids(
    images: tuple[SensorImage, SensorImage],
    parts: tuple[Window, Window],
    elevation: Any,
    spacing: float = 1.0,
    step: int = STEP,
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[int, int], float]:
    """Return grids over parts of both images, rows and columns, and pixels of the left image per metre of height."""
    areas = [
        SimpleNamespace(
            transform=Affine.translation(one.origin[1] + part.column, one.origin[0] + part.row),
            nb_rows=part.height,
            nb_columns=part.width,
            pixel_size_row=spacing,
            pixel_size_col=spacing,
        )
        for one, part in zip(images, parts, strict=True)
    ]
    root = logging.getLogger()  # to which shareloc tells that nodes are NaN
    root.addFilter(_drop)
    try:
        with warnings.catch_warnings(action="ignore"):
            left, right, shape, base = compute_stereorectification_epipolar_grids(
                areas[0], images[0].model, areas[1], images[1].model, elevation, epi_step=step, margin=_margin(step)
            )
    finally:
        root.removeFilter(_drop)
    nodes = np.ascontiguousarray(left[..., :2]), np.ascontiguousarray(right[..., :2])
    return nodes, (int(shape[0]), int(shape[1])), float(base)


def _drop(record: logging.LogRecord) -> bool:
    return False


def _pixel_size(of: SensorImage, part: Window, height: float) -> float:
    """Return the side in metres of a pixel in the middle of a part of an image, as large on the ground."""
    row = of.origin[0] + part.row + part.height / 2 + np.array([0.0, 1.0, 0.0])
    column = of.origin[1] + part.column + part.width / 2 + np.array([0.0, 0.0, 1.0])
    corner, down, across = coordinates_conversion(of.model.direct_loc_h(row, column, height), 4326, 4978)
    return float(np.sqrt(np.linalg.norm(np.cross(down - corner, across - corner))))


def _footprint(left: SensorImage, nodes: np.ndarray, shape: tuple[int, int], height: float) -> list[list[float]]:
    """Return longitude and latitude of the corners of the epipolar image, by the nodes next to them."""
    ends = [(MARGIN, MARGIN + round(size / STEP)) for size in shape]
    corners = nodes[[ends[0][0], ends[0][1], ends[0][1], ends[0][0]], [ends[1][0], ends[1][0], ends[1][1], ends[1][1]]]
    ground = left.model.direct_loc_h(corners[:, 0], corners[:, 1], height)
    return [[round(float(value), 7) for value in corner[:2]] for corner in ground]


def _dem(left: SensorImage, right: SensorImage, nodes: np.ndarray, terrain: Terrain, height: float) -> Any:
    """Return the DEM around all left nodes, which shareloc follows, or its only height; raise if it is smaller."""
    dem, geoid = str(terrain.dem), terrain.geoid and str(terrain.geoid)
    ground = left.model.direct_loc_h(*nodes[:: len(nodes) - 1].reshape(-1, 2).T, height)[:, :2]
    heights, place = ground_of(path_of(dem), (*ground.min(axis=0), *ground.max(axis=0)), _AROUND)
    with TemporaryDirectory() as folder:  # shareloc takes places of a projected DEM for degrees
        write_layer(file := Path(folder) / "dem.tif", heights, np.nan, place)
        read = read_with(path_of(dem), "DEM", lambda _: dtm_reader(str(file), geoid))
    if not np.isfinite(read.alt_data).all():
        given = f"{dem} with {geoid}" if geoid else dem
        raise SatIntervalsError(f"{given} has no heights at a part of the images: give files that cover them")
    for one in (left, right):
        one.check_height(float(np.median(read.alt_data)), f"{dem}: median height")
    if not np.ptp(read.alt_data):  # the sea: shareloc finds no points on one height
        return float(read.alt_data.flat[0])
    return DTMIntersection(read.epsg, read.alt_data, read.nb_rows, read.nb_columns, read.transform)
