"""Reopen a finished run from its folder: report, bands, input images and truth."""

import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.config import Config, Regularization, load_config
from sat_intervals.errors import SatIntervalsError, check_file
from sat_intervals.kernels.confidence import low_confidence
from sat_intervals.kernels.row_offsets import RowOffsets
from sat_intervals.products import BANDS, ORTHO, REGULARIZED, Bands
from sat_intervals.raster import (
    Georeferencing,
    Image,
    check_not_replaced,
    open_image,
    path_of,
    read_layers,
    read_place,
    read_tags,
)
from sat_intervals.raster.identity import absolute_in, identities
from sat_intervals.raster.images import opened
from sat_intervals.raster.layers import is_surface_of, tags_beside
from sat_intervals.raster.windows import Layer, read_small_image, read_small_layers
from sat_intervals.tiling import Window, strips

# Pixels in a strip, and band count of each file.
_STRIP = 1 << 23
_BANDS = {"intervals.tif": range(len(BANDS)), "validity.tif": range(1)}
# Of a sweep of many images: height, lower and upper bound, confidence.
_BANDS_OF_SWEEP = {"dsm.tif": (0, 1, 2, 4), "validity.tif": range(1)}
# Files that later commands add to a run: the command, and whether a file is of the run that finished at a time.
_ADDED: dict[str, tuple[str, Callable[[Path, str], bool]]] = {
    "dsm.tif": ("dsm", is_surface_of),
    "report.html": ("report", lambda file, finished: finished in file.read_text(encoding="utf-8")),
    "overview.png": ("plot", lambda file, finished: read_tags(file).get("Comment") == finished),
}

_LOG = logging.getLogger(__name__)


class Quantity(NamedTuple):
    """What the bands of a run are: names, unit, units in a step of the search, lowest and highest searched."""

    name: str
    plural: str
    unit: str
    step: float
    minimum: float
    maximum: float


@dataclass(frozen=True)
class Run:
    """A finished run; rows and columns of its results count from the first pixel of ``region`` in the left image."""

    out: Path
    report: dict[str, Any]
    config: Config
    region: Window
    georeferencing: Georeferencing

    def __getstate__(self) -> dict[str, Any]:
        """Return what workers need: a report with local ranges is large."""
        return self.__dict__ | {"report": {}}

    @property
    def bands(self) -> Mapping[str, Sequence[int]]:
        """Return the files of the run with the indices of the bands of `Bands`."""
        return _BANDS_OF_SWEEP if self.is_sweep else _BANDS

    @property
    def is_sweep(self) -> bool:
        """Return whether the run compared many images at heights: it has no disparities and no left image."""
        return not self.config.cost.compares_two

    @property
    def quantity(self) -> Quantity:
        """Return what the bands are: heights in metres of a sweep, else disparities in pixels."""
        if self.is_sweep:
            swept = self.report["sweep"]
            return Quantity("height", "heights", "m", swept["step"], *swept["heights"])
        search = self.config.disparity
        return Quantity("disparity", "disparities", "px", 1, search.minimum, search.maximum)

    @property
    def images(self) -> dict[str, dict[str, Any]]:
        """Return the records of the images by their titles, such as 'left image' or 'image 3'."""
        inputs = self.report["inputs"]
        if self.is_sweep:
            return {name.replace("_", " "): one for name, one in inputs.items() if name.startswith("image_")}
        return {f"{side} image": inputs[side] for side in ("left", "right")}

    def check_pair(self) -> None:
        """Raise if the run is a sweep, which has no disparities of a pair."""
        if self.is_sweep:
            many = f"the surface of {len(self.images)} images, without disparities of a pair"
            raise SatIntervalsError(f"{self.out} is {many}: use {self.out / 'dsm.tif'}, or give the folder of a pair")

    @property
    def shape(self) -> tuple[int, int]:
        """Return the rows and columns of the results."""
        return self.region.height, self.region.width

    @property
    def left_georeferencing(self) -> Georeferencing:
        """Return the georeferencing of the whole left image."""
        return self.georeferencing.shifted(Window(-self.region.row, -self.region.column, *self.shape))

    @property
    def rows(self) -> RowOffsets | None:
        """Return the row offsets that were taken out of the right image."""
        return RowOffsets.of_report(self.report["rows"]) if self.report.get("rows") else None

    @property
    def truth_beside(self) -> Path:
        """Return the default path of the truth, ``truth.tif`` beside the left image."""
        return path_of(self.report["inputs"]["left"]["path"]).parent / "truth.tif"

    def read_bands(self, window: Window) -> Bands:
        """Read the bands of a window of the results."""
        layers = ((read_layers(self.out / name, window), chosen) for name, chosen in self.bands.items())
        return Bands(*(bands[i] for bands, chosen in layers for i in chosen))

    def windows(self) -> Iterator[Window]:
        """Yield full-width windows of the results from the top."""
        return strips(*self.shape, _STRIP)

    def has_current(self, name: str) -> bool:
        """Return whether the folder has a file of a later command, made of this run; warn if it is of another one."""
        if name in self.bands:
            return True
        command, is_of = _ADDED[name]
        if not (file := self.out / name).exists() or is_of(file, self.report["finished"]):
            return file.exists()
        _LOG.warning("%s is of another run and is left out: rerun sat-intervals %s", file, command)
        return False

    @property
    def ortho(self) -> Path | None:
        """Return the ortho-image of a current surface of the run, on its grid; None without one."""
        surface, ortho = self.out / "dsm.tif", self.out / ORTHO
        if not ortho.exists():
            return None
        is_of = read_tags(ortho).get("RUNS") == read_tags(surface).get("RUNS")
        return ortho if is_of and read_place(ortho) == read_place(surface) else None

    def check_kept(self, outputs: Iterable[str | Path], inputs: Iterable[str | Path | None] = ()) -> None:
        """Raise if an output would replace a file of the run, its inputs, a given truth, or one of ``inputs``."""
        own = [self.out / name for name in (*self.bands, "run.json")]
        grid = self.config.disparity.grid  # other rasters are inputs
        truth = self.truth_beside
        given = None if truth.exists() and "REFERENCE" in read_tags(truth) else truth  # `reference` may replace its own
        check_not_replaced([*own, *identities(self.report["inputs"]), grid, given, *inputs], outputs)

    def layer(self, path: str | Path) -> Layer:
        """Open another raster of the same pixels, such as the truth."""
        image = open_image(path)
        left = self.report["inputs"]["left"]
        here = self.region.in_words
        size, there = (image.height, image.width), tags_beside(image.path, left).get("REGION", here)
        if size == self.shape:
            if there != here:
                raise SatIntervalsError(f"{image.path} is of {there}, {self.out} of {here}: give one of this run")
            return Layer(image, 0, 0)
        if size == (left["height"], left["width"]):
            return Layer(image, self.region.row, self.region.column)
        sizes = f"the left image {left['height']} x {left['width']}, the run {self.shape[0]} x {self.shape[1]}"
        raise SatIntervalsError(f"{image.path} has {size[0]} x {size[1]} pixels, {sizes}: give a file of such a size")


@dataclass(frozen=True)
class Results(Run):
    """A finished run with its images and, if known, the truth."""

    left: Image
    right: Image
    truth: Layer | None

    def read(self, window: Window) -> Bands:
        """Read bands, left image and truth of a window of the results."""
        image = Layer(self.left, self.region.row, self.region.column).read(window)
        truth = self.truth.read(window) if self.truth else np.full(image.shape, np.nan)
        return self.read_bands(window)._replace(truth=truth, image=image)

    def read_pixel(self, row: int, column: int) -> Bands:
        """Read bands, left image and truth of one pixel as zero-dimensional arrays."""
        self.check_pixel(row, column)
        return Bands(*(band[0, 0] for band in self.read(Window(row, column, 1, 1))[:-2]))  # no extra bands

    def strips(self) -> Iterator[tuple[int, Bands]]:
        """Yield the first row and the content (see `read`) of each strip, from the top."""
        yield from ((window.row, self.read(window)) for window in self.windows())

    def read_small(self, shape: tuple[int, int]) -> Bands:
        """Read all bands, from overviews, and the left image at ``shape`` pixels; no truth."""
        layers = ((read_small_layers(self.out / name, shape), chosen) for name, chosen in self.bands.items())
        bands = Bands(*(bands[i] for bands, chosen in layers for i in chosen))
        return bands._replace(image=read_small_image(self.left, self.region, shape))

    def read_small_left(self, window: Window, shape: tuple[int, int]) -> np.ndarray:
        """Read the left image under a window of the results at ``shape`` pixels."""
        place = Window(self.region.row + window.row, self.region.column + window.column, window.height, window.width)
        return read_small_image(self.left, place, shape)

    def low(self, bands: Bands) -> np.ndarray:
        """Return the mask of low-confidence pixels (paper eq. 12 and 13) of whole rows, with defaults if it was off."""
        settings = self.config.regularization or Regularization()
        if self.is_sweep:  # rough ground is low, too
            return np.asarray(bands.validity & REGULARIZED != 0)
        return np.asarray(low_confidence(bands.confidence, settings.threshold, settings.kernel))

    def check_pixel(self, row: int, column: int) -> None:
        """Raise if a pixel is outside the results."""
        height, width = self.shape
        if not (0 <= row < height and 0 <= column < width):
            place = f"row {row}, column {column} is outside the results in {self.out}"
            raise SatIntervalsError(f"{place}: rows are 0 to {height - 1}, columns 0 to {width - 1}")

    def check_part(self, row: int, columns: tuple[int, int] | None) -> tuple[int, int]:
        """Raise if a part of a row is outside the results; return its first and last column (None means all)."""
        first, last = columns or (0, self.region.width - 1)
        self.check_pixel(row, first)
        self.check_pixel(row, last)
        if first > last:
            raise SatIntervalsError(f"columns {first} to {last} are in the wrong order: give the smaller one first")
        return first, last


def open_run(out: str | Path) -> Run:
    """Open the folder of a finished run: its two rasters and ``run.json``. Images are not needed."""
    file = path_of(out) / "run.json"
    try:
        report = json.loads(file.read_bytes())
        region = Window(**report["tiles"]["region"])
        report["inputs"] = absolute_in(file.parent, report["inputs"])
        config = load_config(report["settings"])
        if not config.cost.compares_two:  # its heights stand for the images of a pair
            heights = {"path": str(file.with_name("dsm.tif")), "band": 1, "mask": None, "nodata": None}
            size = {"height": region.height, "width": region.width}
            report["inputs"] |= dict.fromkeys(("left", "right"), heights | size)
    except OSError as error:
        raise SatIntervalsError(f"{file}: {error.strerror}: give the folder of a finished run") from error
    except SatIntervalsError as error:
        raise SatIntervalsError(f"{file}: {error}: made by another version, match again with --overwrite") from error
    except (ValueError, LookupError, TypeError) as error:
        raise SatIntervalsError(f"{file} is not the report of a run: match again with --overwrite") from error
    for name in _BANDS if config.cost.compares_two else _BANDS_OF_SWEEP:
        check_file(file.with_name(name), "give the folder of a finished run, or match with --overwrite")
    with opened(str(file.with_name("validity.tif"))) as dataset:
        return Run(file.parent, report, config, region, Georeferencing.of(dataset))


def read_change(out: str | Path) -> dict[str, Any] | None:
    """Return the content of ``change.json`` of a folder; None without the file, or if the folder has a run."""
    file = path_of(out) / "change.json"
    is_change = file.exists() and not file.with_name("run.json").exists()
    return dict(json.loads(file.read_bytes())) if is_change else None


def open_results(out: str | Path, truth: str | Path | None = None) -> Results:
    """Open a finished run, its images and its truth, by default ``truth.tif`` beside the left image if it exists."""
    run = open_run(out)
    if truth is not None:
        run.check_pair()
    left, right = (open_input(run.report["inputs"][side]) for side in ("left", "right"))
    right = replace(right, rows=run.rows)
    truth = truth or (run.truth_beside if not run.is_sweep and run.truth_beside.exists() else None)
    return Results(**vars(run), left=left, right=right, truth=None if truth is None else run.layer(truth))


def open_input(record: dict[str, Any]) -> Image:
    """Reopen an input image of a run, from its report."""
    name = record["path"]
    mask = record["mask"]
    nodata = record["nodata"]
    if name.startswith("/") and not name.startswith("/vsi") and not Path(name).exists():
        raise SatIntervalsError(f"{name}, an image of the run, is missing: move it back, or put a link to it there")
    return open_image(name, band=record["band"], nodata=nodata and float(nodata), mask=mask and mask["path"])
