"""A pair made ready to be matched: images opened and checked, its folder, its tiles, its store."""

import os
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Config, load_config
from sat_intervals.errors import SatIntervalsError
from sat_intervals.finish import Rows, Scale, finish_strips
from sat_intervals.inputs import identity
from sat_intervals.memory import fitted, parse_bytes
from sat_intervals.patch import match_patch
from sat_intervals.raster import Image, check_pair, check_space, open_image
from sat_intervals.store import Store
from sat_intervals.tiling import Grid, Window

OUTPUTS = ("intervals.tif", "validity.tif", "run.json")


@dataclass(frozen=True)
class Job:
    """What a worker needs to match any tile of a pair, and what comes after.

    Attributes
    ----------
    left, right
        The images.
    config
        Settings.
    store
        Where tiles go; its grid says which there are.
    out
        Folder of the run.
    inputs
        What run.json says of the images.
    """

    left: Image
    right: Image
    config: Config
    store: Store
    out: Path
    inputs: dict[str, Any]

    def begin(self, *, overwrite: bool = False) -> None:
        """Open the store for what decides the bytes of a tile; to be called while it is locked."""
        manifest = {
            "version": version("sat-intervals"),
            "settings": self.config.model_dump(mode="json", exclude={"cluster"}),
            "inputs": self.inputs,
            "region": asdict(self.store.grid.region),
        }
        self.store.open(manifest, overwrite=overwrite)

    @property
    def waiting(self) -> int:
        """Number of tiles that are not done."""
        return sum(not self.store.is_done(tile) for tile in self.store.grid)


def prepare(
    left: str | Path | Image,
    right: str | Path | Image,
    out: str | Path,
    config: Any,
    *,
    window: Window | None = None,
    overwrite: bool = False,
) -> Job:
    """Check all that can be checked before a pixel is read; parameters as of `match_pair`."""
    config, out = load_config(config), Path(out)
    if config.cluster.memory is not None:
        config = fitted(config, parse_bytes(config.cluster.memory), config.cluster.cores)
    left, right = checked_pair(left, right, config)
    region = _region(left, window)
    check_output(out, overwrite)
    check_space(out, region.height, region.width)
    store = Store(out / "tiles", Grid(region, config.tiles.size), config.disparity.count, config.largest_ambiguity)
    inputs = {"left": _described(left), "right": _described(right)}
    return Job(left, right, config, store, out, inputs)


def checked_pair(left: str | Path | Image, right: str | Path | Image, config: Config) -> tuple[Image, Image]:
    """Open the images of a pair and check that they can be matched."""
    left, right = (image if isinstance(image, Image) else open_image(image) for image in (left, right))
    check_pair(left, right, config.disparity.minimum, config.disparity.maximum)
    return left, right


def check_output(out: Path, overwrite: bool) -> None:
    """Make the folder of a run, or tell why it cannot be used."""
    there = [name for name in OUTPUTS if (out / name).exists()]
    if there and not overwrite:
        raise SatIntervalsError(f"{out} already holds a run ({', '.join(there)}): choose another folder or --overwrite")
    try:
        out.mkdir(parents=True, exist_ok=True)
        os.utime(out)
    except OSError as error:
        raise SatIntervalsError(f"{out} cannot be written: {error.strerror}") from error


def compile_kernels(config: Config) -> None:
    """Match a few random pixels, so that every kernel is compiled, or read from numba's cache, once and first."""
    random = np.random.default_rng(0)

    def read(window: Window) -> tuple[np.ndarray, np.ndarray]:
        pixels = random.random((window.height, window.width), np.float32)
        return pixels, np.zeros(pixels.shape, np.uint8)

    spot = Window(0, 0, 4, 4)
    patch = match_patch(read, read, spot, spot, spot, config)
    raw = patch.raw
    rows = Rows(raw.winner, raw.lower, raw.upper, raw.disparity, raw.ambiguity, raw.validity, patch.right.winner)
    list(finish_strips([rows], Scale(0.0, 1.0), config))


def _region(left: Image, window: Window | None) -> Window:
    whole = Window(0, 0, left.height, left.width)
    if window is None:
        return whole
    if window.height < 1 or window.width < 1 or window.clipped(whole) != window:
        raise SatIntervalsError(
            f"window at row {window.row}, column {window.column}, {window.height} x {window.width} pixels: "
            f"must lie inside {left.path}, {left.height} x {left.width} pixels"
        )
    return window


def _described(image: Image) -> dict[str, Any]:
    """What run.json and the manifest say of an input."""
    crs = image.georeferencing.crs
    return {
        **identity(image.path),
        "height": image.height,
        "width": image.width,
        "band": image.band,
        "dtype": image.dtype,
        "nodata": None if image.nodata is None else repr(image.nodata),
        "crs": crs.to_string() if crs else None,
        "mask": identity(image.mask) if image.mask else None,
    }
