"""Plan a surface of raw images: their geometry is found, and a sample is matched."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sat_intervals.config import Cluster, Config, resolved
from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.dsm import check_sensors, checked_cells
from sat_intervals.heights.rectify import IMAGES, rectified_files
from sat_intervals.match.costs import check_cost
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.progress import Progress, clocked, timed
from sat_intervals.raster import Image, open_image, surface_file
from sat_intervals.raster.publishing import file_bytes, part_bytes
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers
from sat_intervals.run.pair import match_and_assemble, match_pair
from sat_intervals.run.plan import Plan, found_range, planned
from sat_intervals.store.lock import locked
from sat_intervals.tiling import Window
from sat_intervals.workflows.many import FIGURES, Wanted, asked_of, found_geometry, geometry_job, with_range
from sat_intervals.workflows.rectify import rectified
from sat_intervals.workflows.surface import check_cells, surface_of

# Sides of the parts of a raw pair that are resampled, in the middle: the first compiles kernels.
_PARTS = 60, 4096


def plan_of_many(
    images: Sequence[Image],
    config: Config,
    wanted: Wanted,
    *,
    memory: int | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Plan:
    """Estimate tiles, memory, disk and time of the surface of three images or more, see `plan` and `surface`."""
    start = dict[str, float]()
    with TemporaryDirectory() as folder:
        with timed(start, "start"), Connection(Cluster(), Path(folder)) as connection:
            asked = asked_of(images, Path(folder), config, wanted)
            geometry = found_geometry(asked, EachOnWorkers(connection, progress))

        def sample(out: Path, one: Config, window: Window) -> dict[str, float]:
            job = replace(geometry_job(replace(asked, config=one), out, geometry, window), overwrite=True)
            seconds = dict(start)
            with locked(out), Connection(one.cluster, out) as workers:
                job.begin()
                match_and_assemble(job, workers, seconds, lambda stage, done, total: None)
            return seconds

        figures = geometry[1]
        region = Window(0, 0, figures["cells"]["rows"], figures["cells"]["columns"])
        used = [asked.images[name] for name in figures["used"]]
        made = planned(used, region, with_range(asked.config, figures), sample, memory=memory)
    return replace(made, sweep={name: figures[name] for name in FIGURES})


def plan_of_raw(
    images: Sequence[Image],
    config: Config,
    cells: dict[str, Any],
    raw: dict[str, Any],
    *,
    memory: int | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Plan:
    """Estimate tiles, memory, disk and time of the surface of a raw pair, see `surface`, from its middle."""
    check_cost(config)
    choices = SurfaceChoices()
    check_cells(resolved(config).interval, **cells, choices=choices)
    _, resolution, crs, radius = checked_cells(**cells)
    cells |= {"resolution": resolution, "crs": crs, "radius": radius, "choices": choices}  # not the grid of a raster
    raw |= {"geoid": cells["geoid"] if raw["dem"] else None}
    with TemporaryDirectory() as name:
        for side in _PARTS:
            folder, start = Path(name) / str(side), dict[str, float]()
            with clocked(start, progress) as look, Connection(Cluster(workers=1), folder) as connection:
                record = rectified(images, folder, EachOnWorkers(connection, look), side=side, **raw)
        left, right = (open_image(folder / one) for one in IMAGES)
        sensors = rectified_files(left.path, right.path) or ()
        check_sensors(sensors, resolution, crs, choices)
        config = found_range(left, right, resolved(config), progress)
        once = start["start"] + start["geometry"]

        def sample(out: Path, one: Config, window: Window) -> dict[str, float]:
            compile_kernels(one)
            seconds = dict(match_pair(left, right, out, one, window=window, overwrite=True)["seconds"])
            for _ in range(2):  # the first compiles kernels
                of_cells = dict[str, float]()
                with clocked(of_cells, lambda *_: None) as look, Connection(one.cluster, out) as workers:
                    surface_of(out, sensors, EachOnWorkers(workers, look), **cells)
            share = window.height * window.width / (left.height * left.width)
            seconds["start"] += once
            seconds["files"] += of_cells["files"] + share * start["files"]
            return seconds | {"cells": of_cells["cells"], "resampling": share * start["resampling"]}

        height, width = record["size"]
        whole = [replace(image, height=height, width=width) for image in (left, right)]
        region, middle = Window(0, 0, height, width), Window(0, 0, left.height, left.width)
        made = planned(whole, region, config, sample, memory=memory, within=middle)
    return replace(made, disk_bytes=made.disk_bytes + _bytes_beside(whole, record["pixel_size"] / resolution))


def _bytes_beside(pair: Sequence[Image], finer: float) -> int:
    """Return the bytes, at most, of an epipolar pair, and of a surface with so many cells along a pixel."""
    height, width = pair[0].height, pair[0].width
    file, shape = [surface_file("dsm.tif")], (round(finer * height), round(finer * width))
    pixels = height * width * sum(np.dtype(image.dtype).itemsize for image in pair)
    return pixels + part_bytes(file, *shape) + file_bytes(file, *shape)
