"""What `rectify` writes to a folder, for later commands: an epipolar pair, its grids and the record of its models."""

import json
from pathlib import Path
from typing import Any

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster.identity import absolute_in

FILE = "rectify.json"
IMAGES = "left.tif", "right.tif"
GRIDS = "left_grid.tif", "right_grid.tif"


def read_record(folder: Path) -> dict[str, Any] | None:
    """Read the record of a folder; None if there is none, or another file of this name."""
    try:
        record = absolute_in(folder, json.loads((folder / FILE).read_bytes()))
        return record if record.keys() >= {"inputs", "settings", "finished"} else None
    except (FileNotFoundError, NotADirectoryError, ValueError, AttributeError):
        return None
    except OSError as error:
        raise SatIntervalsError(f"{folder / FILE} cannot be read: {error.strerror}: choose another folder") from error


def rectified_files(left: str | Path, right: str | Path) -> tuple[Path, Path, Path, Path] | None:
    """Return models and grids of an epipolar pair that `rectify` has made; None if it has not."""
    folder = Path(left).parent
    if Path(right).parent != folder or (Path(left).name, Path(right).name) != IMAGES:
        return None
    record = read_record(folder)
    if record is None:
        return None
    if not record["finished"]:
        raise SatIntervalsError(f"{folder} holds an unfinished pair: rerun rectify")
    left_model, right_model = (Path(record["inputs"][f"{side}_model"]["path"]) for side in ("left", "right"))
    return left_model, right_model, folder / GRIDS[0], folder / GRIDS[1]
