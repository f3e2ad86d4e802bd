"""What several test modules do: write a pair, run a command, wait, and compare runs."""

import hashlib
import json
import sysconfig
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from click.testing import CliRunner, Result

from sat_intervals.cli import main
from sat_intervals.demo import Scene
from sat_intervals.raster import north_up, write_layer

COMMAND = Path(sysconfig.get_path("scripts")) / "sat-intervals"
OUTPUTS = ["intervals.tif", "run.json", "validity.tif"]
PLACE = north_up(32631, 300_000, 4_800_000, 0.5)
PATIENCE = 60.0


def write_pair(folder: Path, scene: Scene, *, group: str = "all", **sections: Any) -> dict[str, Any]:
    """Write the images and the truth of a scene, meta.json and settings.yaml: the settings, its range and sections."""
    for name, nodata in (("left", 0), ("right", 0), ("truth", np.nan)):
        write_layer(folder / f"{name}.tif", getattr(scene, name), nodata, PLACE)
    (folder / "meta.json").write_text(json.dumps({"disparity": [scene.minimum, scene.maximum], "group": group}))
    settings = {"disparity": {"minimum": scene.minimum, "maximum": scene.maximum}} | sections
    (folder / "settings.yaml").write_text(yaml.safe_dump(settings))
    return settings


def invoke(*arguments: object) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def wait_until(holds: Callable[[], object], what: str, seconds: float = PATIENCE) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"{what}: not within {seconds:.0f} s"
        time.sleep(0.002)


def hashes(out: Path) -> dict[str, str]:
    """SHA-256 of the products of a run."""
    return {name: hashlib.sha256((out / name).read_bytes()).hexdigest() for name in OUTPUTS if name.endswith(".tif")}
