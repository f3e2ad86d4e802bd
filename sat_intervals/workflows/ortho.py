"""Write the ortho-image of a sweep: the median of all images, resampled to the surface."""

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.ortho import Drape
from sat_intervals.progress import Progress
from sat_intervals.run.job import Job


def write_ortho(job: Job, progress: Progress) -> None:
    """Write the ortho-image beside the surface of a finished run; an existing file is replaced."""
    surface, ground = job.out / "dsm.tif", job.prepared.ground
    assert ground
    if not surface.exists():
        raise SatIntervalsError(f"{surface} is missing: run the same command with --overwrite")
    drape = Drape.of(surface, [*job.images.values()], ground)
    drape.write("median of the images that see the cell, resampled to the surface; no data without a height", progress)
