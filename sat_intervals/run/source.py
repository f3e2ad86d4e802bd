"""Provide the input of a step: pixels of a block and costs of its tiles, computed now or kept by an earlier step."""

from typing import NamedTuple

import numpy as np

from sat_intervals.kernels.cost import padded_to_lanes
from sat_intervals.match.costs import MatchingCost
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import VolumeOf, cost_areas, view_windows
from sat_intervals.match.mccnn import Network, network_of
from sat_intervals.match.normalization import PairStatistics
from sat_intervals.match.patch import Frame, patch_areas
from sat_intervals.progress import timed
from sat_intervals.raster import read_views
from sat_intervals.raster.windows import kept_view, restored_view
from sat_intervals.run.job import Job
from sat_intervals.run.workers import is_remote
from sat_intervals.store.arrays import numbered
from sat_intervals.store.tiles import COSTS, PIXELS
from sat_intervals.tiling import Tile, Views, Window, hull


class Source(NamedTuple):
    """Both images in windows that contain those of some tiles, the image statistics, and what makes costs.

    network: of MC-CNN, or the function that makes the volumes of another matcher; None for others.
    """

    views: Views
    statistics: PairStatistics | None
    network: Network | VolumeOf | None


def frame_of(job: Job, tile: Tile) -> Frame:
    """Return a tile or block in its region and image."""
    return Frame(tile.core, job.store.grid.region, Window(0, 0, job.left.height, job.left.width))


def read_source(job: Job, block: Tile, ranges: LocalRanges | None, seconds: dict[str, float]) -> Source:
    """Read both images in the windows of a block's tiles."""
    job.check_version()  # before any work
    statistics, network = job.prepared.statistics, job.volume_of or network_of(job.config.cost, job.inputs)
    areas = (patch_areas(frame_of(job, tile), job.config, ranges) for tile in job.store.grid.within(block.core))
    windows = [view_windows(of_tile, job.config) for of_tile in areas]
    left, right = map(hull, zip(*windows, strict=True))
    with timed(seconds, "read"):
        return Source(_views(job, block, (left, right)), statistics, network)


def _views(job: Job, block: Tile, windows: tuple[Window, Window]) -> Views:
    """Read windows of both images; the first of a block's steps keeps them on the disk, in the type of the file."""
    images = job.left, job.right
    are_kept = job.hands_states_on and not is_remote(job.config.cluster)
    if are_kept and (kept := job.store.read(PIXELS, block.name)) is not None:
        left, right = (
            restored_view(image, window, *kept[2 * i : 2 * i + 2])
            for i, (image, window) in enumerate(zip(images, windows, strict=True))
        )
        return left, right
    views = read_views(images, windows)
    if are_kept:
        arrays = [array for image, view in zip(images, views, strict=True) for array in kept_view(image, view)]
        job.store.write(PIXELS, block.name, numbered(arrays))
    return views


def costed(
    job: Job, tile: Tile, source: Source, ranges: LocalRanges | None, seconds: dict[str, float]
) -> tuple[Views, list[MatchingCost]]:
    """Crop both images to a tile, and compute the costs of its areas; precomputed ones are kept for other steps."""
    areas, config, name = patch_areas(frame_of(job, tile), job.config, ranges), job.config, tile.name
    of_pair = source.statistics, source.network
    left, right = zip(source.views, view_windows(areas, config), strict=True)
    views = left[0].cropped(left[1]), right[0].cropped(right[1])
    if not (config.cost.precomputed and job.hands_states_on):
        with timed(seconds, "match"):
            return views, cost_areas(views, areas, config, *of_pair)
    with timed(seconds, "read"):
        kept = job.store.read(COSTS, name)
    if kept is None:
        with timed(seconds, "costs"):
            made = cost_areas(views, areas, config, *of_pair)
            kept = [cost.costs.left[:, :, : area.disparities] for area, cost in zip(areas, made, strict=True)]
            job.store.write(COSTS, name, numbered(kept))
        return views, made
    missing = [padded_to_lanes(costs.shape[2]) - costs.shape[2] for costs in kept]
    padded = [np.pad(costs, [(0, 0), (0, 0), (0, more)]) for costs, more in zip(kept, missing, strict=True)]
    with timed(seconds, "match"):
        return views, cost_areas(views, areas, config, *of_pair, padded)
