"""Where raw images show ground cells: the grid that at least two of them see, positions there, and pairs to compare."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.ground import read_with_ground
from sat_intervals.heights.lattice import Extent
from sat_intervals.heights.models import SensorImage
from sat_intervals.heights.point_cloud import Cells
from sat_intervals.match.ground import BLOCK, GroundViews
from sat_intervals.raster import Image, Projection, acquired, between_180, find_model

# Nodes along an image and a grid at which a footprint is looked for, and heights.
_SIDE, _NODES, _LEVELS = 9, 65, 9
# Metres between heights at which positions are known, at most, and their number.
_SPACING, _MOST = 50.0, 33
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
        SensorImage.readings(one, Path(model) if model else None) for one, model in zip(images, given, strict=False)
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


def common_cells(
    images: Sequence[SensorImage], projection: Projection, heights: tuple[float, float], resolution: float
) -> Cells:
    """Return the cells that at least two images see at one of a range of heights; raise without any."""
    levels = np.linspace(*heights, _LEVELS)
    box = _footprint(images, projection, heights)
    x, y = np.meshgrid(np.linspace(box.left, box.right, _NODES), np.linspace(box.top, box.bottom, _NODES))
    sizes = np.array([(one.image.height, one.image.width) for one in images])[:, None, None, :]
    seen = np.zeros((len(images), *x.shape), bool)
    shared = np.zeros(x.shape, bool)
    for height in levels:
        places = positions(images, projection, x, y, height)
        inside = ((places >= -0.5) & (places <= sizes - 0.5)).all(axis=-1)
        common = inside.sum(axis=0) >= 2
        shared, seen = shared | common, seen | (inside & common)
    if not shared.any():
        raise SatIntervalsError("no two images see the same ground: give images of one place")
    for one, places in zip(images, seen, strict=True):
        if not places.any():
            raise SatIntervalsError(f"{one.image.path} sees no ground that another image sees: leave it out")
    across, down = (box.right - box.left) / (_NODES - 1), (box.top - box.bottom) / (_NODES - 1)
    extent = Extent(x[shared].min() - across, y[shared].min() - down, x[shared].max() + across, y[shared].max() + down)
    return Cells.over(extent, resolution)


def _footprint(images: Sequence[SensorImage], projection: Projection, heights: tuple[float, float]) -> Extent:
    corners = []
    for one in images:
        rows, columns = (
            first + np.linspace(0, size, _SIDE)
            for first, size in zip(one.origin, (one.image.height, one.image.width), strict=True)
        )
        row, column = (axis.ravel() for axis in np.meshgrid(rows, columns, indexing="ij"))
        for height in heights:
            up = projection.undulation(np.array([one.model.offset_x]), np.array([one.model.offset_y]))
            points = one.model.direct_loc_h(row, column, np.full(row.size, height + float(up[0])))
            corners.append(np.stack(projection.place(points[:, 0], points[:, 1])))
    x, y = np.concatenate(corners, axis=1)
    return Extent(float(x.min()), float(y.min()), float(x.max()), float(y.max()))


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
    least = min(_RATIOS[0], max(ratios.values()) / 2)
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
