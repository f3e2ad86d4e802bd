"""Align runs of one place: the shifts in space that make their surfaces fit each other.

Models of images are off by a pixel or so, and surfaces of their pairs by as much. Each two surfaces are registered on
blocks of ground that both have; least squares over all these shifts give one of each run, with mean 0.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.point_cloud import Cells, PointCloud
from sat_intervals.kernels.gridding import mean_heights
from sat_intervals.kernels.registration import REACH, Registration, part_of, put_together, register, spread_blocks
from sat_intervals.prepare.pair import Each
from sat_intervals.raster import is_ground, north_up, read_heights
from sat_intervals.tiling import Window

# Smallest side of the blocks that register, in cells.
_SMALLEST = 16
# What pulls the mean of all shifts to 0, or the reference, in inverse metres.
_HELD = 1e3
_LEAST, _FAR = 0.01, 500.0  # metres: least deviation of a shift; largest difference from a reference in height


def aligned(
    each: Each,
    clouds: Sequence[PointCloud],
    cells: Cells,
    crs: str,
    radius: float,
    reference: Path | None = None,
) -> tuple[list[PointCloud], list[dict[str, Any]]]:
    """Move the points of runs onto each other, or onto a raster of reference heights.

    Also return the shift of each run, easting, northing and height in metres, with its ``deviation``, None if unknown.
    Raises `SatIntervalsError` for a run that has no ground with the reference, or is far from it.
    """
    count = len(clouds) + bool(reference)
    heights_only = [PointCloud(one.run, one.ground.lattice, replace(one.choices, bounds="envelope")) for one in clouds]
    cores = spread_blocks(Window(0, 0, cells.rows, cells.columns), _SMALLEST)
    arguments = []
    for core in cores:
        around = core.grown(REACH + 1, REACH + 1)
        extent = cells.extent(around).grown(radius)
        arguments.append(([one.near(extent) for one in heights_only], cells, crs, radius, reference, around))
    blocks = dict(each(_heights, arguments, "alignment"))
    inner = slice(REACH + 1, -REACH - 1)
    found = {
        (one, other): [part_of(blocks[n][one], blocks[n][other][inner, inner]) for n in range(len(cores))]
        for one, other in combinations(range(count), 2)
    }
    pairs = {pair: register(put_together(parts, cells.resolution, moves=-1)) for pair, parts in found.items()}
    known = {pair: one for pair, one in pairs.items() if one}
    shifts, deviations = solved(known, count, has_reference=bool(reference))
    moved, report = [], []
    for cloud, shift, deviation in zip(clouds, shifts, deviations, strict=False):
        if reference and np.isnan(deviation[2]):
            raise SatIntervalsError(f"{cloud.run.out} has no ground with {reference}: give a reference of this place")
        if reference and abs(shift[2]) > _FAR:
            raise SatIntervalsError(
                f"{cloud.run.out} and {reference} differ by {shift[2]:.0f} m in height: check that both are metres "
                "above the same datum"
            )
        lattice = cloud.ground.lattice
        moved.append(PointCloud(cloud.run, replace(lattice, nodes=lattice.nodes + shift), cloud.choices))
        known_deviation = [one if np.isfinite(one) else None for one in deviation.tolist()]
        report.append({"run": str(cloud.run.out), "shift": shift.tolist(), "deviation": known_deviation})
    return moved, report


def _heights(
    clouds: Sequence[PointCloud], cells: Cells, crs: str, radius: float, reference: Path | None, around: Window
) -> list[np.ndarray]:
    """Return the heights of all runs and the reference on a block and around it; runs on a worker."""
    # float32, since those of all blocks are kept; NaN where there is no height
    heights = [mean_heights(cloud.splat(cells, around, radius)[0]).astype(np.float32) for cloud in clouds]
    if reference:
        place = north_up(crs, cells.left, cells.top, cells.resolution).shifted(around)
        shape = around.height, around.width
        known = read_heights(reference, place, shape, Window(0, 0, *shape), smooth=True)
        heights.append(np.where(is_ground(known), known, np.nan).astype(np.float32))
    return heights


def solved(
    pairs: Mapping[tuple[int, int], Registration], count: int, *, has_reference: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return shifts and deviations, ``(count, 3)``, by weighted least squares over the shifts of pairs.

    Deviations are NaN of runs that no pairs link to the reference, which is the last one, or to all others.
    """
    shifts, deviations = np.zeros((count, 3)), np.full((count, 3), np.nan)
    for axis in range(3):
        known = {pair: one for pair, one in pairs.items() if np.isfinite(one.deviation[axis])}
        rows, values = np.zeros((len(known) + 1, count)), np.zeros(len(known) + 1)
        for row, ((one, other), found) in enumerate(known.items()):
            weight = 1 / max(found.deviation[axis], _LEAST)
            rows[row, [one, other]], values[row] = (-weight, weight), weight * found.shift[axis]
        rows[-1, -1 if has_reference else slice(None)] = _HELD
        inverse = np.linalg.pinv(rows)
        shifts[:, axis] = inverse @ values
        linked = {count - 1}
        for _ in range(count):
            linked |= {end for pair in known if linked & {*pair} for end in pair}
        if has_reference or len(linked) == count:
            met = sorted(linked)
            deviations[met, axis] = np.sqrt(np.square(inverse).sum(axis=1))[met]
    return shifts, deviations
