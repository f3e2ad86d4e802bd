"""Find the run that an earlier call of the same command has finished, and remove what that call left."""

import logging
from pathlib import Path
from typing import Any

from sat_intervals.config import Config, resolved
from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import RUN_FILES, Image, remove_scratch
from sat_intervals.results import open_run
from sat_intervals.run.inputs import changes_since, with_range_of
from sat_intervals.run.job import fitted_to_jobs
from sat_intervals.run.output import check_as_published, is_complete
from sat_intervals.run.workers import reason
from sat_intervals.store.folder import LocalFolder
from sat_intervals.store.manifest import StoreError
from sat_intervals.store.marks import finished_run
from sat_intervals.store.place import place_of, run_of
from sat_intervals.store.tiles import remove_tiles
from sat_intervals.tiling import Window

_LOG = logging.getLogger(__name__)


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


def tidy(folder: Path, keep_tiles: bool, store: str | None) -> None:
    """Remove what a run left that was killed after it published its files; tiles are kept if asked for."""
    remove_scratch(folder, RUN_FILES)
    home = folder / "tiles"
    if keep_tiles or home.is_symlink() or finished_run(home) is None:
        return
    try:
        place = place_of(home, store)
        is_at_home, run = place == LocalFolder(home.absolute()), run_of(place)
        if is_at_home or run:
            with LocalFolder(home).locked():
                check_as_published(folder)
                remove_tiles(LocalFolder(home), place if is_at_home else place.of_run(run))
    except (StoreError, OSError) as error:  # the run is complete
        _LOG.warning("the tiles of the complete run stay: %s", reason(error))
