"""Compare ``points.tif`` with the size and checksum that were published with it."""

import json
from pathlib import Path

from sat_intervals.errors import SatIntervalsError, open_regular
from sat_intervals.raster.files import POINT_FILES
from sat_intervals.raster.identity import checksum_of, known_checksum
from sat_intervals.raster.layers import read_alone
from sat_intervals.raster.publishing import POINTS_REPORT
from sat_intervals.raster.seal import check_seal

POINTS_FILE = POINT_FILES[0].name


def check_points(out: Path) -> None:
    """Raise if the bytes of ``points.tif`` differ from those that were published, or from the CRC-32 in it.

    Without ``points.json``, there is only the latter. Earlier versions wrote neither.

    Raises
    ------
    SatIntervalsError
        Names the damaged file, or one beside it that GDAL reads too.
    """
    read_alone(out / POINTS_FILE)
    published = published_points(out)
    if published is None:
        check_seal(out / POINTS_FILE, [])
    elif published != checksum_of(out / POINTS_FILE):
        raise SatIntervalsError(
            f"{out / POINTS_FILE} is not what triangulate published; it is damaged or was changed: move it away and "
            "triangulate again"
        )


def published_points(out: Path) -> dict[str, int] | None:
    """Return size and CRC-32 of ``points.tif`` from ``points.json``; None if that is missing."""
    file = out / POINTS_REPORT
    try:
        with open_regular(file) as stream:
            report = json.loads(stream.read().decode())
        if report.keys() != {"files"}:  # it was edited
            raise LookupError(file)
        return known_checksum(report["files"][POINTS_FILE])
    except FileNotFoundError:
        return None
    except SatIntervalsError:
        raise
    except OSError as error:
        raise SatIntervalsError(f"{file} cannot be read: {error.strerror}: move it away") from error
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise SatIntervalsError(
            f"{file} is not the report of {POINTS_FILE}: move it away and triangulate again"
        ) from error
