"""Reopen a finished run from its folder: report, bands, input images and truth."""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from operator import index
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, NonNegativeInt, PositiveInt, ValidationError

from sat_intervals.config import Config, Regularization, load_config
from sat_intervals.errors import RunError, SatIntervalsError, check_file, open_regular
from sat_intervals.kernels.confidence import low_confidence
from sat_intervals.products import BANDS, Bands
from sat_intervals.raster import (
    Georeferencing,
    Image,
    Layer,
    open_image,
    read_alone,
    read_layers,
    read_small_image,
    read_small_layers,
)
from sat_intervals.raster.identity import check_not_replaced, checksum_of, is_changed, known_checksum, stamp_of
from sat_intervals.raster.published import tags_beside
from sat_intervals.raster.watching import watched
from sat_intervals.store.manifest import SEAL, unsealed
from sat_intervals.tiling import Window, strips

# Pixels in a strip, and band count of each file.
_STRIP = 1 << 23
_BANDS = {"intervals.tif": len(BANDS), "validity.tif": 1}
_REGION = ("row", "column", "height", "width")
# Digits of integers in a report: longer ones fit no type of an array.
_DIGITS = 18


class _Section(BaseModel, strict=True):
    """What commands need of a section of ``run.json``; what has a default, earlier versions did not write."""


class _File(_Section):
    path: str = Field(min_length=1)


class _Input(_File):
    band: PositiveInt
    height: PositiveInt
    width: PositiveInt
    nodata: str | None
    mask: _File | None


class _Counts(_Section):
    pixels: PositiveInt
    valid: NonNegativeInt
    low_confidence: NonNegativeInt
    causes: dict[str, NonNegativeInt] = {}
    range_ends: dict[str, NonNegativeInt] = {}
    median_interval_width: float | None


class _Search(_Section):
    matched: float
    levels: list[dict[str, float]]
    histogram: dict[str, list[float]]
    cells: dict[str, Any] = {}


class _Report(_Section):
    finished: str
    inputs: dict[str, _Input]
    counts: _Counts
    versions: dict[str, Any]
    search: _Search | None = None
    local_ranges: dict[str, Any] | None = None
    normalization: dict[str, dict[str, float]] | None = None


@dataclass(frozen=True)
class Run:
    """The folder of a finished run.

    Attributes
    ----------
    out
        The folder.
    report
        Content of ``run.json``.
    config
        Settings of the run.
    region
        The pixels of the left image that were matched. Rows and columns of the results count from its first pixel.
    which
        Stamps of ``run.json`` and the rasters, which change when they are replaced.
    georeferencing
        Georeferencing of the results.
    """

    out: Path
    report: dict[str, Any]
    config: Config
    region: Window
    which: tuple[str | None, ...]
    georeferencing: Georeferencing

    @property
    def shape(self) -> tuple[int, int]:
        """Return the rows and columns of the results."""
        return self.region.height, self.region.width

    @property
    def left_georeferencing(self) -> Georeferencing:
        """Return the georeferencing of the whole left image."""
        region = self.region
        return self.georeferencing.shifted(Window(-region.row, -region.column, region.height, region.width))

    def read_bands(self, window: Window) -> Bands:
        """Read the bands of a window of the results."""
        with self.unchanged():
            return Bands(
                *read_layers(self.out / "intervals.tif", window), *read_layers(self.out / "validity.tif", window)
            )

    @contextmanager
    def unchanged(self, *others: str) -> Iterator[None]:
        """Raise at the end of the block if the run, or one of ``others`` in its folder, was replaced.

        Raises
        ------
        RunError
            One was replaced.
        SatIntervalsError
            A file appeared beside a raster of the run that changes what is read from it.
        """
        check_files = watched(self.out / name for name in (*others, "run.json", *_BANDS))
        try:
            yield
        finally:
            if _which(self.out) != self.which:
                raise RunError(f"the run in {self.out} was replaced while it was read: rerun the command")
        check_files()
        for name in _BANDS:
            read_alone(self.out / name)

    def windows(self) -> Iterator[Window]:
        """Yield full-width windows of the results from the top."""
        return strips(*self.shape, _STRIP)

    def check_kept(self, outputs: Iterable[str | Path], inputs: Iterable[str | Path | None] = ()) -> None:
        """Raise if an output would replace a file of the run, one of its inputs, the truth, or one of ``inputs``."""
        own = [self.out / name for name in (*_BANDS, "run.json")]
        grid = self.config.disparity.grid
        check_not_replaced([*own, *_input_files(self.report["inputs"]), grid, self.truth_beside, *inputs], outputs)

    def layer(self, path: str | Path) -> Layer:
        """Open another raster of the same pixels, such as the truth."""
        image, left = open_image(path), self.report["inputs"]["left"]
        size = image.height, image.width
        here = self.region.in_words
        tags = tags_beside(image.path, left)
        if size == self.shape and (there := tags.get("REGION", here)) != here:
            raise SatIntervalsError(f"{image.path} is of {there}, {self.out} of {here}: give one of this run")
        if size == self.shape:
            return Layer(image, 0, 0)
        if size == (left["height"], left["width"]):
            return Layer(image, self.region.row, self.region.column)
        raise SatIntervalsError(
            f"{image.path} has {image.height} x {image.width} pixels, the left image {left['height']} x "
            f"{left['width']}, the run {self.region.height} x {self.region.width}: give a file of one of these sizes"
        )

    @property
    def truth_beside(self) -> Path:
        """Return the default path of the truth, ``truth.tif`` beside the left image."""
        return Path(self.report["inputs"]["left"]["path"]).parent / "truth.tif"


@dataclass(frozen=True)
class Results(Run):
    """A finished run with its images and, if known, the truth.

    Attributes
    ----------
    left, right
        The images that the run read.
    truth
        True disparity, None if unknown.
    """

    left: Image
    right: Image
    truth: Layer | None

    @property
    def images(self) -> list[Image]:
        """Return all images that were opened: left, right and, if known, the truth."""
        return [self.left, self.right, *([self.truth.image] if self.truth else [])]

    def read(self, window: Window) -> Bands:
        """Read bands, left image and truth of a window of the results."""
        image = Layer(self.left, self.region.row, self.region.column).read(window)
        truth = self.truth.read(window) if self.truth else np.full(image.shape, np.nan)
        return self.read_bands(window)._replace(truth=truth, image=image)

    def read_pixel(self, row: int, column: int) -> Bands:
        """Read bands, left image and truth of one pixel as zero-dimensional arrays."""
        self.check_pixel(row, column)
        return Bands(*(band[0, 0] for band in self.read(Window(row, column, 1, 1))))

    def strips(self) -> Iterator[tuple[int, Bands]]:
        """Yield the first row and the content (see `read`) of each strip, from the top."""
        yield from ((window.row, self.read(window)) for window in self.windows())

    def read_small(self, shape: tuple[int, int]) -> Bands:
        """Read all bands and the left image at ``shape`` pixels: bands subsampled, the image averaged; no truth."""
        with self.unchanged():
            layers = (read_small_layers(self.out / name, shape) for name in ("intervals.tif", "validity.tif"))
            bands = Bands(*(layer for of_file in layers for layer in of_file))
        return bands._replace(image=read_small_image(self.left, self.region, shape))

    def low(self, bands: Bands) -> np.ndarray:
        """Return the mask of low-confidence pixels (paper eq. 12 and 13) of whole rows.

        A run without regularisation uses its default settings.
        """
        settings = self.config.regularization or Regularization()
        return np.asarray(low_confidence(bands.confidence, settings.threshold, settings.kernel))

    def read_small_left(self, window: Window, shape: tuple[int, int]) -> np.ndarray:
        """Read the left image under a window of the results at ``shape`` pixels."""
        place = Window(self.region.row + window.row, self.region.column + window.column, window.height, window.width)
        return read_small_image(self.left, place, shape)

    def check_pixel(self, row: int, column: int) -> None:
        """Raise if a pixel is outside the results."""
        height, width = self.shape
        if not (0 <= row < height and 0 <= column < width):
            raise SatIntervalsError(
                f"row {row}, column {column} is outside the results in {self.out}: "
                f"rows are 0 to {height - 1}, columns 0 to {width - 1}"
            )

    def check_part(self, row: int, columns: tuple[int, int] | None) -> tuple[int, int]:
        """Raise if a part of a row is outside the results; return its first and last column (None means all)."""
        first, last = columns or (0, self.region.width - 1)
        self.check_pixel(row, first)
        self.check_pixel(row, last)
        if first > last:
            raise SatIntervalsError(f"columns {first} to {last} are in the wrong order: give the smaller one first")
        return first, last


def open_run(out: str | Path) -> Run:
    """Open the folder of a finished run: ``intervals.tif``, ``validity.tif`` and ``run.json``. Images are not needed.

    Raises
    ------
    SatIntervalsError
        The folder is not a finished run, its files do not belong together, or it was another run for a moment.
    """
    out = Path(out)
    file = out / "run.json"
    check_steady = watched([file, *(out / name for name in _BANDS)], is_local=True)
    try:
        which = _which(out)
        with open_regular(file) as stream:
            text = stream.read().decode()
        report = json.loads(text, parse_int=_integer)
        if report.pop(SEAL, None) is not None and unsealed(text) is None:
            raise SatIntervalsError("it is damaged or was changed: restore it, or move it away and match again")
        json.dumps(report, ensure_ascii=False, allow_nan=False).encode()  # raises for NaN and lone surrogates
        config = load_config(report["settings"])
        images = {side: report["inputs"][side] for side in ("left", "right")}  # MC-CNN has weights, too
        _Report.model_validate(report | {"inputs": images})
        for image in images.values():
            _nodata(image)
        region = Window(**{name: index(report["tiles"]["region"][name]) for name in _REGION})
        files = {name: known_checksum(file) for name, file in report.get("files", {}).items()}
    except OSError as error:
        raise SatIntervalsError(f"{file}: {error.strerror}: give the folder of a finished run") from error
    except SatIntervalsError as error:
        raise SatIntervalsError(f"{file}: {error}") from error
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        where = ", see " + ".".join(map(str, error.errors()[0]["loc"])) if isinstance(error, ValidationError) else ""
        raise SatIntervalsError(
            f"{file} is not the report of a run{where}: move it away and match again with --overwrite"
        ) from error
    try:
        places = [_checked_place(out / name, bands, region, files.get(name)) for name, bands in _BANDS.items()]
    finally:
        check_steady()  # the rasters of another run are not damaged
    return Run(out, report, config, region, which, places[-1])


def _which(out: Path) -> tuple[str | None, ...]:
    """Return the `stamp_of` the files of a run."""
    return tuple(stamp_of(str(out / name)) for name in ("run.json", *_BANDS))


def _input_files(inputs: Any) -> Iterator[str]:
    """Yield the paths of all files in the section ``inputs`` of a report, at any depth."""
    for value in inputs.values() if isinstance(inputs, dict) else inputs if isinstance(inputs, list) else ():
        yield from _input_files(value)
    if isinstance(inputs, dict) and isinstance(inputs.get("path"), str):
        yield inputs["path"]


def _integer(text: str) -> int:
    """Return an integer of a report; raise if it is too long to be one."""
    if len(text) > _DIGITS:
        raise ValueError(text)
    return int(text)


def _nodata(record: dict[str, Any]) -> float | None:
    return None if record["nodata"] is None else float(record["nodata"])


def _checked_place(file: Path, bands: int, region: Window, published: dict[str, int] | None) -> Georeferencing:
    """Return the georeferencing of a raster; raise if it is missing, or not as the report of its run says.

    GDAL decodes most flipped bits of a compressed block without an error. Earlier versions wrote no checksums.
    """
    if not file.exists():
        raise SatIntervalsError(f"{file} is missing: give the folder of a finished run, or match with --overwrite")
    check_file(file, "move it away and match again with --overwrite")
    if published and published != checksum_of(file):
        raise SatIntervalsError(
            f"{file} is not what the run published; it is damaged or was changed: move it away and match again with "
            "--overwrite"
        )
    found, place = read_alone(file)
    needed = bands, region.height, region.width
    if found != needed:
        raise SatIntervalsError(
            f"{file} has {found[0]} bands of {found[1]} x {found[2]} pixels, but run.json says {needed[0]} of "
            f"{needed[1]} x {needed[2]}: move it away and match again with --overwrite"
        )
    return place


def open_results(out: str | Path, truth: str | Path | None = None) -> Results:
    """Open the folder of a finished run, its images and its truth.

    Parameters
    ----------
    out
        Folder of ``intervals.tif``, ``validity.tif`` and ``run.json``.
    truth
        True disparity of the left image or of the matched region; by default ``truth.tif`` beside the left image, if it
        exists.

    Raises
    ------
    SatIntervalsError
        The folder is not a finished run, an image has changed since, or the truth has another size.
    """
    run = open_run(out)
    left, right = (open_input(run.report["inputs"][side]) for side in ("left", "right"))
    truth = truth or (run.truth_beside if run.truth_beside.exists() else None)
    layer = None if truth is None else run.layer(truth)
    return Results(**vars(run), left=left, right=right, truth=layer)


def open_input(record: dict[str, Any]) -> Image:
    """Reopen an input image; raise if it has changed since the run."""
    name, mask = record["path"], record["mask"]
    if name.startswith("/") and not name.startswith("/vsi") and not Path(name).exists():
        raise SatIntervalsError(f"{name}, an image of the run, is missing: move it back, or put a link to it there")
    image = open_image(name, band=record["band"], nodata=_nodata(record), mask=mask and mask["path"])
    if (image.height, image.width) != (record["height"], record["width"]):
        raise SatIntervalsError(
            f"{image.path} has {image.height} x {image.width} pixels, but had {record['height']} x {record['width']} "
            "when it was matched: restore that image or match again"
        )
    if image.use_mask != record.get("use_mask", image.use_mask):
        raise SatIntervalsError(f"{image.path} has got or lost a mask since it was matched: restore it or match again")
    for file in (record, *record.get("files", ()), *([mask, *mask.get("files", ())] if mask else [])):
        if is_changed(file["path"], file):
            raise SatIntervalsError(f"{file['path']} has changed since it was matched: restore it or match again")
    return image
