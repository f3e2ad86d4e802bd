"""Files that ``sat-intervals calibrate`` writes: YAML after an explanation."""

import os
from pathlib import Path
from typing import Any


def check_output(output: Path, *, overwrite: bool) -> None:
    """Raise if a file cannot be written, or exists and may not be replaced."""
    from sat_intervals.raster.publishing import OutputError, check_free

    check_free(output, overwrite=overwrite)
    if not os.access(output.absolute().parent, os.W_OK):
        raise OutputError(f"{output} cannot be written: give --output a file in an existing folder")


def write(output: Path, head: str, content: dict[str, Any]) -> None:
    """Write a file; ``head`` is its explanation, lines of comments."""
    import yaml

    from sat_intervals.raster.publishing import write_file

    write_file(output, f"{head}{yaml.safe_dump(content, sort_keys=False, width=120)}".encode())
