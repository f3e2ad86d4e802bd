"""Make the built-in calibrations (`make calibration`), one for each preset, on the pairs of ``SAT_INTERVALS_SHARED``.

Twelve scenes with truth to 1/3 px or better. Those of the satellite presets have two WorldView-3 tiles beside them,
with LiDAR truth in whole pixels: their bias is removed, and a truth within 1 px of an interval counts as inside.
"""

import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from sat_intervals.config import PRESETS

DATA = Path(os.environ.get("SAT_INTERVALS_SHARED", "../shared")) / "data"
OUT = Path(__file__).parents[2] / "configs" / "calibrations"
MIDDLEBURY = (
    "mb2001_venus", "mb2003_cones", "mb2003_teddy", "mb2005_art", "mb2005_books", "mb2005_dolls", "mb2005_laundry",
    "mb2005_moebius", "mb2005_reindeer",
)  # fmt: skip
SYNTHETIC = ("synth_toulouse_georef", "synth_toulouse_nodata", "synth_toulouse_urban")
DEVELOPMENT = MIDDLEBURY + SYNTHETIC
WORLDVIEW = ("us3d_jax_079", "us3d_jax_559")
COLUMNS = ("name", "left", "right", "truth", "minimum", "maximum", "tolerance", "remove_bias")


def scenes_of(preset: str) -> tuple[str, ...]:
    """Return the scenes that the calibration of a preset is made from."""
    return DEVELOPMENT + WORLDVIEW if preset.startswith("satellite") else DEVELOPMENT


def row_of(scene: str) -> tuple[object, ...]:
    """Return the row of a scene in a table of pairs."""
    folder = DATA / scene
    files = [(folder / f"{name}.tif").resolve() for name in ("left", "right", "truth")]
    is_lidar = scene in WORLDVIEW
    search = json.loads((folder / "meta.json").read_text())["disparity"]
    return (scene, *files, *search, int(is_lidar), str(is_lidar).lower())


def main() -> None:
    """Make the calibrations of the presets that are named, by default of all."""
    OUT.mkdir(exist_ok=True)
    for preset in sys.argv[1:] or PRESETS:
        with tempfile.TemporaryDirectory() as folder:
            table = Path(folder) / "pairs.csv"
            with table.open("w", newline="") as file:
                csv.writer(file).writerows([COLUMNS, *map(row_of, scenes_of(preset))])
            output = OUT / f"{preset}.yaml"
            command = [Path(sys.executable).with_name("sat-intervals"), "calibrate", table, "--preset", preset]
            subprocess.run([*map(str, command), "--output", str(output)], check=True)


if __name__ == "__main__":
    main()
