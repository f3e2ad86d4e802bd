"""Provide the input of a step: pixels of a block and costs of its tiles, computed now or kept by an earlier step."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sat_intervals.kernels.cost import padded_to_lanes
from sat_intervals.match.costs import cost_of
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import Area, AreaCosts, Given, MatchingCost
from sat_intervals.match.patch import PatchFrame, patch_areas
from sat_intervals.progress import timed
from sat_intervals.raster import read_reduced_views, read_views
from sat_intervals.raster.windows import kept_view, restored_view
from sat_intervals.run.job import Job
from sat_intervals.run.workers import is_remote
from sat_intervals.store.arrays import numbered
from sat_intervals.store.tiles import COSTS, PIXELS
from sat_intervals.tiling import Tile, Views, Window, hull


class Source(NamedTuple):
    """The images in windows that contain those of some tiles, the matching cost, and costs that were kept."""

    views: Views
    cost: MatchingCost
    kept: list[np.ndarray] | None


def frame_of(job: Job, tile: Tile) -> PatchFrame:
    """Return a tile or block in its region and image."""
    return PatchFrame(tile.core, job.store.grid.region, Window(0, 0, job.left.height, job.left.width))


def read_source(job: Job, block: Tile, ranges: LocalRanges | None, seconds: dict[str, float]) -> Source:
    """Read the images in the windows of a block's tiles."""
    job.check_version()  # before any work
    cost = cost_of(job.config, Given(job.prepared.statistics, job.inputs, job.volume_of, job.ground(), ranges))
    areas = [patch_areas(frame_of(job, tile), job.config, ranges) for tile in job.store.grid.within(block.core)]
    windows = [hull(of_image) for of_image in zip(*map(cost.windows, areas), strict=True)]
    with timed(seconds, "read"):
        kept = _kept_costs(job, block, areas[0]) if _keeps_costs(job) else None
        views = () if kept and job.swept else _views(job, block, windows)  # these costs say all of the images
        return Source(views, cost, kept)


def _keeps_costs(job: Job) -> bool:
    return bool(job.config.cost.precomputed and job.hands_states_on)


def _kept_costs(job: Job, tile: Tile, areas: Sequence[Area]) -> list[np.ndarray] | None:
    """Return what an earlier step has kept of a tile, which is a block: volumes, padded, and images that see cells."""
    kept = job.store.read(COSTS, tile.name)
    if kept is None:
        return None
    missing = [padded_to_lanes(area.disparities) - area.disparities for area in areas]
    padded = [np.pad(costs, [(0, 0), (0, 0), (0, more)]) for costs, more in zip(kept, missing, strict=False)]
    return padded + kept[len(areas) :]


def _views(job: Job, block: Tile, windows: Sequence[Window]) -> Views:
    """Read windows of the images; the first of a block's steps keeps them on the disk, in the type of the file."""
    images, ground = tuple(job.images.values()), job.ground()
    if ground:
        return read_reduced_views(images, windows, ground.reductions)
    are_kept = job.hands_states_on and not is_remote(job.config.cluster)
    if are_kept and (kept := job.store.read(PIXELS, block.name)) is not None:
        return tuple(
            restored_view(image, window, *kept[2 * i : 2 * i + 2])
            for i, (image, window) in enumerate(zip(images, windows, strict=True))
        )
    views = read_views(images, windows)
    if are_kept:
        arrays = [array for image, view in zip(images, views, strict=True) for array in kept_view(image, view)]
        job.store.write(PIXELS, block.name, numbered(arrays))
    return views


def costed(
    job: Job, tile: Tile, source: Source, ranges: LocalRanges | None, seconds: dict[str, float]
) -> tuple[Views, list[AreaCosts]]:
    """Crop the images to a tile, and compute the costs of its areas; precomputed ones are kept for other steps."""
    areas = patch_areas(frame_of(job, tile), job.config, ranges)
    windows = source.cost.windows(areas)
    views = tuple(view.cropped(window) for view, window in zip(source.views, windows, strict=False))
    keeps = _keeps_costs(job) and source.kept is None
    with timed(seconds, "costs" if keeps else "match"):
        made = source.cost.of_areas(views, areas, source.kept)
        if keeps:
            volumes = [cost.costs.left[:, :, : area.disparities] for area, cost in zip(areas, made, strict=True)]
            seen = [cost.seen for cost in made if cost.seen is not None]
            job.store.write(COSTS, tile.name, numbered([*volumes, *seen]))
    return views, made
