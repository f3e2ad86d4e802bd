"""Functions shared by test modules: write a pair, run a command, wait, compare runs."""

import hashlib
import json
import subprocess
import sysconfig
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import reference
import yaml
from click.testing import CliRunner, Result

from sat_intervals.cli import main
from sat_intervals.config import Config, key_of
from sat_intervals.config.calibration import COVERAGES
from sat_intervals.demo import Scene
from sat_intervals.kernels.cost import between, census
from sat_intervals.kernels.matching import match_costs
from sat_intervals.kernels.sweeps import Settings
from sat_intervals.products import INVALID
from sat_intervals.raster import north_up, write_layer
from sat_intervals.tiling import Window

COMMAND = Path(sysconfig.get_path("scripts")) / "sat-intervals"
OUTPUTS = ["intervals.tif", "run.json", "validity.tif"]
LOCK = ".sat-intervals.lock"
PLACE = north_up(32631, 300_000, 4_800_000, 0.5)
PATIENCE = 150.0
VRT = """<VRTDataset rasterXSize="100" rasterYSize="80"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>
<SourceFilename relativeToVRT="1">mask.tif</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"""
STATISTICS = (
    '<PAMDataset><PAMRasterBand band="1"><Metadata><MDI key="STATISTICS_MEAN">7</MDI></Metadata></PAMRasterBand>'
    "</PAMDataset>"
)


def write_pair(folder: Path, scene: Scene, *, group: str = "all", **sections: Any) -> dict[str, Any]:
    """Write images and truth of a scene, meta.json and settings.yaml; return these: the paper's, range, sections."""
    for name, nodata in (("left", 0), ("right", 0), ("truth", np.nan)):
        write_layer(folder / f"{name}.tif", getattr(scene, name), nodata, PLACE)
    (folder / "meta.json").write_text(json.dumps({"disparity": [scene.minimum, scene.maximum], "group": group}))
    search = {"minimum": scene.minimum, "maximum": scene.maximum}
    settings = {"preset": "paper", "disparity": search} | sections
    (folder / "settings.yaml").write_text(yaml.safe_dump(settings))
    return settings


def calibration(config: Config, high: float, low: float, quantile: float | None) -> dict[str, Any]:
    """A calibration of some settings with the same levels for every coverage."""
    row = {"high": high, "edge": high, "low": low, "quantile": quantile}
    return {"name": "flat", "key": key_of(config), "levels": [{"coverage": c} | row for c in COVERAGES]}


def invoke(*arguments: object) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen]:
    """A command as a process of its own that does not outlive the test."""
    command = [str(argument) for argument in (COMMAND, *arguments, "--quiet")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def ended(process: subprocess.Popen, seconds: float = PATIENCE) -> tuple[int, str]:
    """Status and output of a process at its end."""
    output, _ = process.communicate(timeout=seconds)
    return process.returncode, output


def wait_until(holds: Callable[[], object], what: str, seconds: float = PATIENCE) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"{what}: not within {seconds:.0f} s"
        time.sleep(0.002)


def hashes(out: Path) -> dict[str, str]:
    """SHA-256 of the products of a run."""
    return {name: hashlib.sha256((out / name).read_bytes()).hexdigest() for name in OUTPUTS if name.endswith(".tif")}


def codes_of(scene):
    """Census codes of a scene of `reference`, left and right."""
    views = (scene.left, scene.left_state), (scene.right, scene.right_state)
    return [census(patch, state, scene.window) for patch, state in views]


def matched(scene, output=None, core=None, **options):
    """Raw products and right view of a scene of `reference`, of the whole patch by default."""
    left, right = codes_of(scene)
    output = output or Window(0, 0, *left.state.shape)
    return match_costs(between(left, right), Settings(**reference.settings_of(scene, **options)), output, core)[:2]


def bands(out):
    """Disparity, lower, upper and confidence of a run, and its validity."""
    with rasterio.open(out / "intervals.tif") as intervals, rasterio.open(out / "validity.tif") as validity:
        return intervals.read(), validity.read(1)


def shares_that_differ(one, other):
    """Shares of the pixels valid in at least one of two runs whose disparity differs, and whose interval differs."""
    (first, flags), (second, other_flags) = bands(one), bands(other)
    either_valid = (flags & INVALID == 0) | (other_flags & INVALID == 0)
    differs = (first != second) & ~(np.isnan(first) & np.isnan(second)) & either_valid
    return differs[0].sum() / either_valid.sum(), (differs[1] | differs[2]).sum() / either_valid.sum()


def refused(arguments, *parts):
    """Run a command that must end with status 2 and one line."""
    result = invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    for part in parts:
        assert part in result.stderr, result.stderr


def contents(folder):
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def fail(*arguments, **options):
    raise OSError(5, "Input/output error")
