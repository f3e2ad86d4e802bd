"""Compare the rows of an epipolar pair on this machine."""

from pathlib import Path
from typing import Any

from sat_intervals.config import load_config
from sat_intervals.match.coarse import NoRangeError
from sat_intervals.prepare.pair import FilePair
from sat_intervals.prepare.prepared import prepare
from sat_intervals.progress import Progress
from sat_intervals.raster import open_image
from sat_intervals.run.each import each_here
from sat_intervals.run.quality import rows_left

# Pixels of median row offset up to which rows correspond.
_AGREE = 0.1


def compared_rows(left: Path, right: Path, progress: Progress) -> dict[str, Any]:
    """Return how far rows of a pair differ: ``text``, ``warnings`` (lines), ``search`` (range) and ``survey``."""
    pair = FilePair(open_image(left), open_image(right))
    with each_here(progress) as each:
        try:
            prepared = prepare(pair, load_config({"rows": "none"}), each)
        except NoRangeError as error:
            return {"text": "not compared: too few matches", "warnings": [str(error)], "search": None, "survey": None}
    survey = prepared.survey
    assert survey is not None  # it was looked at
    text = "not compared: too few matches"
    if rows := survey.rows:
        is_taken = survey.is_large and not rows.contradiction
        does = "match takes them out" if is_taken else "match leaves them"
        left_over = (rows.after if is_taken else rows.before)[0]
        verdict = f"correspond within {_AGREE:g} px" if left_over <= _AGREE else f"differ by {left_over:.2f} px"
        text = (
            f"offsets of {rows.before[0]:.2f} px in the median, up to {rows.farthest:.2f} px; {does}; {rows.kind} "
            f"leaves {rows.after[0]:.2f} px on other matches: rows {verdict}"
        )
    warnings = rows_left(survey, "auto", str(right))
    return {"text": text, "warnings": warnings, "search": survey.search, "survey": survey.report()}
