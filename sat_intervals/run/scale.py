"""Find the scale of confidence from the tiles of a run, or say why no pixel could be matched."""

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.postprocess import ConfidenceScale, confidence_scale
from sat_intervals.run.job import Job
from sat_intervals.store.tiles import DamagedTilesError, Records


def checked_scale(job: Job, records: Records) -> ConfidenceScale:
    """Return the scale of confidence of a run whose tiles are done; without confidence, NaN.

    Raises
    ------
    DamagedTilesError
        Tiles are missing; a retry restores them.
    SatIntervalsError
        No pixel could be matched; with the likely reason.
    """
    missing = [tile.name for tile in job.store.grid if tile.name not in records]
    if missing:
        raise DamagedTilesError(
            f"tiles {', '.join(missing)} are missing in {job.store.folder}: rerun the same command: it resumes"
        )
    histogram = job.store.histogram(records)
    if not histogram.any():
        raise _nothing_matched(job, records)
    nothing = ConfidenceScale(np.nan, np.nan)
    return confidence_scale(job.config.ambiguity, histogram) if job.config.ambiguity else nothing


def _nothing_matched(job: Job, records: Records) -> SatIntervalsError:
    usable = {side: sum(record["usable_pixels"][side] for record in records.values()) for side in ("left", "right")}
    empty = [image.path for image, side in ((job.left, "left"), (job.right, "right")) if not usable[side]]
    search, window = job.config.disparity, job.config.cost.window
    reason = (
        f"all pixels of {' and '.join(empty)} are no data or masked"
        if empty
        else f"nowhere do both images have {window} x {window} usable pixels"
    )
    return SatIntervalsError(
        f"no pixel of {job.left.path} can be matched in {job.right.path} over disparities {search.minimum} to "
        f"{search.maximum}, {reason}: check no-data values, masks, window and search range"
    )
