"""Files that ``sat-intervals calibrate`` writes: YAML after an explanation and a CRC-32."""

import os
from pathlib import Path
from typing import Any


def checked_folder(output: Path, head: str) -> Path:
    """Return the folder of a file, where tiles are kept meanwhile; raise if it cannot be written.

    A file is replaced only if the first line of its explanation is that of ``head``, so that it is of the same kind,
    and it was not changed since.
    """
    from sat_intervals.config.sealing import is_as_made
    from sat_intervals.errors import SatIntervalsError, check_regular, open_regular

    folder = output.absolute().parent
    if output.is_dir() or not os.access(folder, os.W_OK):
        raise SatIntervalsError(f"{output} cannot be written: give --output a file in an existing folder")
    check_regular(output, "move it away")
    if output.exists():
        mark = (head.partition("\n")[0] + "\n").encode()
        with open_regular(output) as stream:
            is_ours = stream.read(len(mark)) == mark and is_as_made(mark + stream.read())  # others may be of any size
        if not is_ours:
            raise SatIntervalsError(
                f"{output} exists and was not made by sat-intervals calibrate, holds something else, or was changed "
                "since: move it away"
            )
    return folder


def write(output: Path, head: str, content: dict[str, Any]) -> None:
    """Write a file; ``head`` is its explanation, lines of comments."""
    import yaml

    from sat_intervals.config.sealing import ROOM, sealed
    from sat_intervals.raster import examined, write_file

    kind, explanation = head.split("\n", 1)
    seal = f"# {ROOM} of this file: delete this line if you edit others."
    text = f"{kind}\n{seal}\n{explanation}{yaml.safe_dump(content, sort_keys=False, width=120)}"
    with examined(output.parent, [output.name]) as there:
        checked_folder(output, head)  # again, after hours
    write_file(output, sealed(text.encode()), there)
