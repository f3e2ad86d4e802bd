"""Find the run that an earlier call of the same command has finished."""

from pathlib import Path
from typing import Any

from sat_intervals.config import Config, resolved
from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import Image
from sat_intervals.results import open_run
from sat_intervals.run.inputs import changes_since, with_range_of
from sat_intervals.run.job import fitted_to_jobs
from sat_intervals.run.output import is_complete
from sat_intervals.tiling import Window


def report_before(
    left: Image, right: Image, folder: Path, settings: Config, window: Window | None
) -> dict[str, Any] | None:
    """Return the report of the complete run in a folder, None without one.

    Raises
    ------
    SatIntervalsError
        It has other settings or images.
    """
    if not is_complete(folder):
        return None
    run = open_run(folder)
    config = fitted_to_jobs(with_range_of(run.report, resolved(settings)))
    if changes := changes_since(run.report, left, right, config, window):
        raise SatIntervalsError(
            f"{folder} already holds another run: {'; '.join(changes)} (choose another folder or --overwrite)"
        )
    return run.report
