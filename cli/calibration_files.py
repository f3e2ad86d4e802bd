"""Files that ``sat-intervals calibrate`` writes: YAML after an explanation."""

import os
from pathlib import Path
from typing import Any

# The first line of their explanations ends so.
_MARK = ", found by sat-intervals calibrate"


def checked_folder(output: Path) -> Path:
    """Return the folder of a file, where tiles are kept meanwhile; raise if it cannot be written."""
    from sat_intervals.errors import SatIntervalsError

    folder = output.absolute().parent
    if output.is_dir() or not os.access(folder, os.W_OK):
        raise SatIntervalsError(f"{output} cannot be written: give --output a file in an existing folder")
    if output.exists() and _MARK.encode() not in output.read_bytes().partition(b"\n")[0]:
        raise SatIntervalsError(f"{output} exists and was not made by sat-intervals calibrate: move it away")
    return folder


def write(output: Path, head: str, content: dict[str, Any]) -> None:
    """Write a file; ``head`` is its explanation, lines of comments."""
    import yaml

    from sat_intervals.raster import whole_file

    assert _MARK in head.partition("\n")[0]
    checked_folder(output)  # again, after hours
    with whole_file(output) as new:
        new.write_text(head + yaml.safe_dump(content, sort_keys=False, width=120), encoding="utf-8")
