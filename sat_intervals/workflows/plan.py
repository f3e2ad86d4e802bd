"""Plan a surface of raw images: their geometry is found, and a sample is matched."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sat_intervals.config import Cluster, Config, resolved
from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.rectify import IMAGES, rectified_files
from sat_intervals.progress import Progress, clocked, timed
from sat_intervals.raster import Image, open_image
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers
from sat_intervals.run.pair import match_and_assemble, match_pair
from sat_intervals.run.plan import Plan, found_range, planned
from sat_intervals.store.lock import locked
from sat_intervals.tiling import Window
from sat_intervals.workflows.many import FIGURES, Wanted, asked_of, found_geometry, geometry_job, with_range
from sat_intervals.workflows.rectify import rectified
from sat_intervals.workflows.surface import surface_of

# Side of the part of a raw pair that is resampled, in the middle.
_MIDDLE = 4096


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
    models: Sequence[Path | None] = (),
    *,
    memory: int | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Plan:
    """Estimate tiles, memory, disk and time of the surface of a raw pair, see `surface`, from its middle."""
    start = dict[str, float]()
    with TemporaryDirectory() as name:
        folder = Path(name)
        with Connection(Cluster(), folder) as connection:
            pool = EachOnWorkers(connection, clocked(start, progress))
            height, width = rectified(images, folder, models, pool, side=_MIDDLE, **raw)["size"]
        left, right = (open_image(folder / one) for one in IMAGES)
        middle = Window(0, 0, left.height, left.width)
        config = found_range(left, right, resolved(config), progress)
        sensors = rectified_files(left.path, right.path) or ()
        resampling = (start.pop("resampling", 0.0) + start.pop("files", 0.0)) / (middle.height * middle.width)

        def sample(out: Path, one: Config, window: Window) -> dict[str, float]:
            seconds = dict(match_pair(left, right, out, one, window=window, overwrite=True)["seconds"])
            of_cells = dict[str, float]()
            with Connection(one.cluster, out) as workers:
                pool = EachOnWorkers(workers, clocked(of_cells, lambda stage, done, total: None))
                surface_of(out, sensors, pool, **cells, choices=SurfaceChoices())
            seconds["start"] += sum(start.values())
            seconds["files"] += of_cells["files"]
            return seconds | {"cells": of_cells["cells"], "resampling": resampling * window.height * window.width}

        whole = [replace(image, height=height, width=width) for image in (left, right)]
        region = Window(0, 0, height, width)
        made = planned(whole, region, config, sample, memory=memory, within=middle)
    pixels = sum(height * width * np.dtype(image.dtype).itemsize for image in whole)
    return replace(made, disk_bytes=made.disk_bytes + pixels)
