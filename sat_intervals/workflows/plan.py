"""Plan a surface of many images: its geometry is found, and a sample is matched."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from sat_intervals.config import Cluster, Config
from sat_intervals.progress import Progress, timed
from sat_intervals.raster import Image
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers
from sat_intervals.run.pair import match_and_assemble
from sat_intervals.run.plan import Plan, planned
from sat_intervals.store.lock import locked
from sat_intervals.tiling import Window
from sat_intervals.workflows.many import FIGURES, Wanted, asked_of, found_geometry, geometry_job, with_range


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
