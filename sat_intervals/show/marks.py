"""Keep files in the place of a picture, page, style, project or text that is not ours, or that was edited."""

import zipfile
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import partial
from io import BytesIO
from pathlib import Path

from sat_intervals.config.sealing import ROOM, is_as_made, sealed
from sat_intervals.errors import SatIntervalsError, open_regular
from sat_intervals.raster import examined, write_file

XML_MARK = f"made by sat-intervals, {ROOM}"
"""Text of the comment in styles; QGIS removes it when it writes the file again."""

TEXT_MARK = f"sat-intervals, {ROOM}"
"""Text of the comment in Markdown, of ``software`` in JSON, and of ``Software`` in pictures."""

# Text near the beginning of the tool's pictures, pages, styles and projects, and of figures in JSON and Markdown.
_MARKS = (
    b"tEXtSoftware\0sat-intervals",
    b'<meta name="generator" content="sat-intervals',
    b"<!--made by sat-intervals",
    b'{\n "software": "sat-intervals',
    b"<!-- sat-intervals",
)
_BEGINNING = 1024  # bytes
_ARCHIVE = b"PK"


def check_made_here(paths: Iterable[Path]) -> None:
    """Raise if one of the files is a folder, or not `is_replaceable`. Links are replaced, never followed: they pass.

    Raises
    ------
    SatIntervalsError
        Names the first such file.
    """
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            raise SatIntervalsError(f"{path} is a folder: move it away")
        if not is_replaceable(path):
            raise SatIntervalsError(
                f"{path} exists and was not made by sat-intervals, was changed since, or is of a version without "
                "checksums: move it away"
            )


def is_replaceable(path: Path) -> bool:
    """Return whether a file is missing, a link, or has the mark of this tool and its bytes agree with the CRC-32 in it.

    An archive has them in its only file.

    Raises
    ------
    SatIntervalsError
        The file cannot be read.
    """
    if not path.is_file() or path.is_symlink():
        return True
    try:
        with open_regular(path) as stream:
            content = stream.read(_BEGINNING)
            if not any(mark in content for mark in _MARKS):  # the file may be of any size
                return False
            content += stream.read()
    except OSError as error:
        raise SatIntervalsError(f"{path} exists and cannot be read: {error.strerror}: move it away") from error
    return bool(is_as_made(_only_file(content) if content.startswith(_ARCHIVE) else content))


def _only_file(archive: bytes) -> bytes:
    """Return the content of the file in an archive; nothing if it is damaged or has several."""
    errors = zipfile.BadZipFile, NotImplementedError, RuntimeError, zlib.error, EOFError, ValueError
    with suppress(*errors), zipfile.ZipFile(BytesIO(archive)) as opened:
        (name,) = opened.namelist()
        return opened.read(name)
    return b""


def replaceable_here(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the `stamps` of files in a folder that may be replaced, after `check_made_here`.

    Raises
    ------
    SatIntervalsError
        See `check_made_here` and `examined`.
    """
    names = tuple(names)
    with examined(folder, names) as there:
        check_made_here(folder / name for name in names)
    return there


def write_made_here(files: Mapping[Path, bytes], there: Mapping[str, str]) -> None:
    """Write files of one folder, `sealed` but for archives; those that are not ours, or not in ``there``, are kept.

    If there is such a file before the first is written, none is. ``there`` is that of `write_file`.

    Raises
    ------
    SatIntervalsError
        Names the file that is kept, or cannot be written.
    """
    check_made_here(files)
    for path, content in files.items():
        content = content if content.startswith(_ARCHIVE) else sealed(content)
        write_file(path, content, there, partial(check_made_here, [path]))  # again: a file may have appeared meanwhile
