"""Prepare a pair alone: find its search range, compare its rows."""

from pathlib import Path
from typing import Any

from sat_intervals.config import Cluster, Config, load_config
from sat_intervals.match.coarse import Found, NoRangeError
from sat_intervals.match.parallax import Survey
from sat_intervals.prepare.local import write_ranges
from sat_intervals.prepare.pair import Each, FilePair
from sat_intervals.prepare.prepared import Prepared, prepare
from sat_intervals.prepare.search_range import undeclared_lines
from sat_intervals.progress import Progress
from sat_intervals.raster import Image, check_not_replaced, files_of, open_image
from sat_intervals.raster.publishing import check_free
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers
from sat_intervals.run.quality import rows_left

# Pixels of median row offset up to which rows correspond.
_AGREE = 0.1


def prepared_here(
    left: Image, right: Image, config: Config, progress: Progress, *, measures_rows: bool = True
) -> Prepared[FilePair]:
    """Prepare a pair on this machine; row offsets stay."""
    config = config.model_copy(update={"rows": "none"})
    with Connection(Cluster(), Path()) as connection:
        return prepare(FilePair(left, right), config, EachOnWorkers(connection, progress), measures_rows=measures_rows)


def range_of_pair(
    left: Image, right: Image, output: Path | None, *, overwrite: bool, progress: Progress
) -> tuple[Found, Survey, list[str]]:
    """Find the search range of a pair; return it, evidence and warnings; write the local ranges to ``output``."""
    if output:
        names = [name for image in (left, right) for name in (image.path, image.mask) if name]
        check_not_replaced([file for name in names for file in (name, *files_of(name))], [output])
        check_free(output, overwrite=overwrite)
    prepared = prepared_here(left, right, load_config(), progress)
    found, survey = prepared.search, prepared.survey
    assert found  # nothing was given
    assert survey
    if output:
        write_ranges(output, found.local, left)
    lines = undeclared_lines(found.undeclared, (left.path, right.path))
    return found, survey, [*lines, *rows_left(survey, "auto", right.path)]


def compared_rows(left: Path, right: Path, each: Each) -> dict[str, Any]:
    """Return how far rows of a pair differ: ``text``, ``warnings`` (lines), ``search`` (range) and ``survey``."""
    text = "not compared: too few matches"
    try:
        survey = prepare(FilePair(open_image(left), open_image(right)), load_config({"rows": "none"}), each).survey
    except NoRangeError as error:
        return {"text": text, "warnings": [str(error)], "search": None, "survey": None}
    assert survey is not None  # it was looked at
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
