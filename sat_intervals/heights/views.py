"""Where raw images show ground cells: the grid that at least two of them see, positions there, and pairs to compare."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.ground import read_with_ground
from sat_intervals.heights.lattice import Extent, joined
from sat_intervals.heights.models import SensorImage
from sat_intervals.heights.point_cloud import Cells
from sat_intervals.match.ground import BLOCK, FEWEST, GroundViews
from sat_intervals.raster import Image, Projection, acquired, between_180, find_model, path_of
from sat_intervals.tiling import Window

# Nodes along an image at which other images are looked for, and heights.
_NODES, _LEVELS = 33, 9
# Metres between heights at which positions are known, at most, and their number.
_SPACING, _MOST = 50.0, 33
# Base-to-height ratio below which heights do not show.
_FLAT = 0.01
# Base-to-height ratios of pairs, and the best one; days between dates that count as much as a ratio of 1, and the days
# of a year, after which the light is the same.
_RATIOS, _BEST, _DAYS, _YEAR = (0.2, 1.0), 0.4, 150.0, 365


def sensors_of(images: Sequence[Image], models: Sequence[str | Path | None]) -> list[SensorImage]:
    """Return images with their models; where tags may be of a crop or of the whole image, as the first image fits."""
    given = [*models, *[None] * len(images)]
    for one, model in zip(images, given, strict=False):
        if not model and find_model(one.path) is None:
            raise SatIntervalsError(f"{one.path} has no RPC model in its tags or beside it: give an image with one")
    readings = [
        SensorImage.readings(one, path_of(model) if model else None) for one, model in zip(images, given, strict=False)
    ]
    first = read_with_ground(readings[0], readings[1], is_needed=False)[0]
    return [first, *(read_with_ground([first], others, is_needed=False)[1] for others in readings[1:])]


def positions(
    images: Sequence[SensorImage], projection: Projection, x: np.ndarray, y: np.ndarray, height: float
) -> np.ndarray:
    """Return ``(images, *x.shape, 2)``: rows and columns in the images of points of a map at a height (metres)."""
    longitude, latitude = (axis.ravel() for axis in projection.degrees(x, y))
    height_there = height + projection.undulation(longitude, latitude)
    found = np.empty((len(images), longitude.size, 2))
    for n, one in enumerate(images):
        near = one.model.offset_x + between_180(longitude - one.model.offset_x)
        row, column, _ = one.model.inverse_loc(near, latitude, height_there)
        found[n] = np.stack([row, column], axis=-1) - one.origin - 0.5
    return found.reshape(len(images), *x.shape, 2)


def views_of(
    images: Sequence[SensorImage],
    projection: Projection,
    cells: Cells,
    heights: tuple[float, float],
    shifts: np.ndarray,
) -> GroundViews:
    """Return where images, whose rows and columns are shifted, show cells over a range of heights; without pairs."""
    count = int(np.clip(np.ceil((heights[1] - heights[0]) / _SPACING) + 1, 2, _MOST))
    levels = np.linspace(*heights, count)
    rows, columns = (
        np.arange(-(-size // BLOCK) + 1) * BLOCK * cells.resolution for size in (cells.rows, cells.columns)
    )
    x, y = np.meshgrid(cells.left + columns, cells.top - rows)
    places = np.stack([positions(images, projection, x, y, height) for height in levels], axis=1)
    step = np.linalg.norm(np.diff(places[:, 0], axis=2), axis=-1).mean(axis=(1, 2)) / BLOCK  # pixels of a cell
    return GroundViews(
        places + shifts[:, None, None, None, :],
        float(levels[0]),
        float(levels[1] - levels[0]),
        tuple(max(1, int(pixels + 0.1)) for pixels in step),
        np.zeros((0, 2), np.int64),
        0.0,
        1.0,
        (cells.rows, cells.columns),
    )


def middle_of(images: Sequence[SensorImage]) -> tuple[float, float]:
    """Return longitude and latitude of the middle of all models."""
    x, y = np.array([(one.model.offset_x, one.model.offset_y) for one in images]).T
    return float(np.mean(x[0] + between_180(x - x[0]))), float(np.mean(y))


def undulation_at(images: Sequence[SensorImage], projection: Projection) -> float:
    """Return the height of the geoid above the ellipsoid in the middle of all models, metres; 0 without a geoid."""
    return float(projection.undulation(*np.array(middle_of(images))[:, np.newaxis])[0])


def common_cells(
    images: Sequence[SensorImage],
    projection: Projection,
    heights: tuple[float, float],
    resolution: float,
    grid: Cells | None = None,
) -> Cells:
    """Return the cells, or blocks of a grid, that two images see at one of a range of heights; raise without any."""
    seen, extents, up = np.zeros(len(images), bool), list[Extent](), undulation_at(images, projection)
    sizes = np.array([(one.image.height, one.image.width) for one in images])[:, np.newaxis]
    for n, one in enumerate(images):  # nodes of each: those of a large image may miss a small one
        ends = zip(one.origin, sizes[n, 0], strict=True)
        nodes = np.meshgrid(*(first + np.linspace(0, size, _NODES) for first, size in ends))
        row, column = (axis.ravel() for axis in nodes)
        for height in np.linspace(*heights, _LEVELS):
            points = one.model.direct_loc_h(row, column, np.full(row.size, height + up))
            ground = np.stack(projection.place(points[:, 0], points[:, 1]))
            places = positions(images, projection, ground[0], ground[1], height)
            inside = np.all((places >= -0.5) & (places <= sizes - 0.5), axis=-1)
            inside[n] = True
            common = inside.sum(axis=0) >= FEWEST
            seen |= (inside & common).any(axis=1)
            if common.any():
                least, most, shared = ground.min(axis=1), ground.max(axis=1), ground[:, common]
                more = (most - least) / (_NODES - 1)
                low, high = np.maximum(least, shared.min(axis=1) - more), np.minimum(most, shared.max(axis=1) + more)
                extents.append(Extent(*map(float, (*low, *high))))
    extent = joined(extents)
    if extent is None:
        raise SatIntervalsError("no two images see the same ground: give images of one place")
    if not seen.all():
        strange = images[int(seen.argmin())].image.path
        raise SatIntervalsError(f"{strange} sees no ground that another image sees: leave it out")
    return _blocks_over(extent, grid) if grid else Cells.over(extent, resolution)


def _blocks_over(extent: Extent, grid: Cells) -> Cells:
    """Return the cells of a grid in whole blocks that cover an extent; raise without any."""
    side = BLOCK * grid.resolution
    first = (grid.top - extent.top) / side, (extent.left - grid.left) / side
    last = (grid.top - extent.bottom) / side, (extent.right - grid.left) / side
    blocks = Window.around(first, last).clipped(Window(0, 0, -(-grid.rows // BLOCK), -(-grid.columns // BLOCK)))
    if not (blocks.height and blocks.width):
        raise SatIntervalsError(
            "on the grid that is given no two images see the same ground: give a grid of this place"
        )
    left, top = grid.left + side * blocks.column, grid.top - side * blocks.row
    rows = min(grid.rows, BLOCK * blocks.row_stop) - BLOCK * blocks.row
    columns = min(grid.columns, BLOCK * blocks.column_stop) - BLOCK * blocks.column
    return Cells(left, top, grid.resolution, rows, columns)


def towards(ground: GroundViews, resolution: float) -> np.ndarray:
    """Return ``(images, 2)``: how far ground of one cell lies from another for a metre of height, in metres: views."""
    places = ground.places
    row, column = (size // 2 - (size > 1) for size in places.shape[2:4])
    middle = places[:, :, row : row + 2, column : column + 2]
    cell = np.stack(
        [(middle[:, 0, 1] - middle[:, 0, 0]).mean(axis=1), (middle[:, 0, :, 1] - middle[:, 0, :, 0]).mean(axis=1)],
        axis=1,
    )
    moved = (middle[:, -1] - middle[:, 0]).mean(axis=(1, 2)) / (ground.spacing * (places.shape[1] - 1))
    return np.asarray(np.einsum("ni,nij->nj", moved, np.linalg.inv(cell / (BLOCK * resolution))))


def with_pairs(ground: GroundViews, paths: Sequence[str], resolution: float, count: int) -> tuple[GroundViews, float]:
    """Return views with ``count`` pairs for each image, and the largest base-to-height ratio among them.

    Pairs of a good ratio and of near dates, where files have dates, come first; each image has at least one.
    """
    views, dates = towards(ground, resolution), [acquired(path) for path in paths]
    every = list(combinations(range(len(paths)), 2))
    ratios = {pair: float(np.linalg.norm(views[pair[0]] - views[pair[1]])) for pair in every}
    if (widest := max(ratios.values())) < _FLAT:
        raise SatIntervalsError(
            f"{', '.join(paths)} show the ground from one direction, with base-to-height ratios up to {widest:.3f}: "
            "give images from other directions, and to each its own RPC model"
        )
    least = min(_RATIOS[0], widest / 2)
    ranked = []
    for pair in every:
        one, other = (dates[n] for n in pair)
        days = abs((one - other).days) if one and other else 0
        days = min(days % _YEAR, -days % _YEAR)
        ratio = ratios[pair]
        ranked.append((not least <= ratio <= _RATIOS[1], days + _DAYS * abs(ratio - _BEST), pair))
    ranked.sort()
    good = [pair for is_poor, _, pair in ranked if not is_poor] or [pair for _, _, pair in ranked]
    chosen = good[: count * len(paths)]
    for n in range(len(paths)):
        if not any(n in pair for pair in chosen):
            chosen.append(next(pair for _, _, pair in ranked if n in pair))
    found = replace(ground, pairs=np.array(sorted(chosen), np.int64))
    return found, max(ratios[pair] for pair in chosen)
