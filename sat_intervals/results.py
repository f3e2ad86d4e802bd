"""A finished run as its folder holds it: what it says of itself, its bands, its images, and a truth beside them."""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from operator import index
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Config, Regularization, load_config
from sat_intervals.errors import RunError, SatIntervalsError, check_regular
from sat_intervals.kernels.confidence import low_confidence
from sat_intervals.products import BANDS, Bands
from sat_intervals.raster import (
    Image,
    open_image,
    read_layers,
    read_shape,
    read_small_image,
    read_small_layers,
    read_window,
)
from sat_intervals.raster.identity import check_not_replaced, checksum_of, is_changed
from sat_intervals.tiling import Window, strips

# Pixels of a strip, and bands of the files.
_STRIP = 1 << 23
_BANDS = {"intervals.tif": len(BANDS), "validity.tif": 1}
_REGION = ("row", "column", "height", "width")


@dataclass(frozen=True)
class Layer:
    """A raster of the size of a run's region or of its left image, read by windows of the region."""

    image: Image
    row: int
    column: int

    def read(self, window: Window) -> np.ndarray:
        """The pixels of a window of the region as floats, NaN where there is no data."""
        place = Window(self.row + window.row, self.column + window.column, window.height, window.width)
        pixels, state = read_window(self.image, place)
        return np.where(state == 0, pixels, np.nan)


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
        See `_which`, of ``run.json``, which goes before and comes after all other files when a run replaces another.
    """

    out: Path
    report: dict[str, Any]
    config: Config
    region: Window
    which: tuple[int, int] | None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the results."""
        return self.region.height, self.region.width

    def read_bands(self, window: Window) -> Bands:
        """What the run wrote of a window of the results."""
        with self.unchanged():
            return Bands(
                *read_layers(self.out / "intervals.tif", window), *read_layers(self.out / "validity.tif", window)
            )

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """A block that reads bands, and fails where they are no longer those of this run."""
        try:
            yield
        finally:
            if _which(self.out / "run.json") != self.which:
                raise RunError(f"the run in {self.out} was replaced while it was read: run the command again")

    def windows(self) -> Iterator[Window]:
        """Full-width windows of the results, from the top."""
        return strips(*self.shape, _STRIP)

    def check_kept(self, outputs: Iterable[str | Path], inputs: Iterable[str | Path | None] = ()) -> None:
        """Hold that none of the files to be written is one of the run, of its inputs, the truth, or ``inputs``."""
        own = [self.out / name for name in (*_BANDS, "run.json")]
        check_not_replaced([*own, *_files_told(self.report["inputs"]), self.truth_beside, *inputs], outputs)

    def layer(self, path: str | Path) -> Layer:
        """Another raster of the same pixels, such as the truth."""
        image, left = open_image(path), self.report["inputs"]["left"]
        size = image.height, image.width
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
        """Where the truth lies by default: beside the left image."""
        return Path(self.report["inputs"]["left"]["path"]).parent / "truth.tif"


@dataclass(frozen=True)
class Results(Run):
    """The folder of a finished run, its images, and a truth.

    Attributes
    ----------
    left, right
        The images, as the run read them.
    truth
        True disparity, None without.
    """

    left: Image
    right: Image
    truth: Layer | None

    def read(self, window: Window) -> Bands:
        """Everything of the pixels of a window of the results."""
        image = Layer(self.left, self.region.row, self.region.column).read(window)
        truth = self.truth.read(window) if self.truth else np.full(image.shape, np.nan)
        return self.read_bands(window)._replace(truth=truth, image=image)

    def read_pixel(self, row: int, column: int) -> Bands:
        """Everything of one pixel, as arrays of no dimension."""
        self.check_pixel(row, column)
        return Bands(*(band[0, 0] for band in self.read(Window(row, column, 1, 1))))

    def strips(self) -> Iterator[tuple[int, Bands]]:
        """Everything, strip by strip from the top, with the first row of each."""
        for window in self.windows():
            yield window.row, self.read(window)

    def read_small(self, shape: tuple[int, int]) -> Bands:
        """All of the results but the truth, as ``shape`` pixels: the bands picked, the left image averaged."""
        with self.unchanged():
            layers = (read_small_layers(self.out / name, shape) for name in ("intervals.tif", "validity.tif"))
            bands = Bands(*(layer for of_file in layers for layer in of_file))
        return bands._replace(image=read_small_image(self.left, self.region, shape))

    def low(self, bands: Bands) -> np.ndarray:
        """Pixels of low confidence (paper eq. 12 and 13) of whole rows.

        Where the run did not regularise, by the default settings of regularisation.
        """
        settings = self.config.regularization or Regularization()
        return np.asarray(low_confidence(bands.confidence, settings.threshold, settings.kernel))

    def read_small_left(self, window: Window, shape: tuple[int, int]) -> np.ndarray:
        """The left image under a window of the results, as ``shape`` pixels."""
        place = Window(self.region.row + window.row, self.region.column + window.column, window.height, window.width)
        return read_small_image(self.left, place, shape)

    def check_pixel(self, row: int, column: int) -> None:
        """Hold that a pixel is one of the results."""
        height, width = self.shape
        if not (0 <= row < height and 0 <= column < width):
            raise SatIntervalsError(
                f"row {row}, column {column} is outside the results in {self.out}: "
                f"rows are 0 to {height - 1}, columns 0 to {width - 1}"
            )

    def check_part(self, row: int, columns: tuple[int, int] | None) -> tuple[int, int]:
        """Hold that a part of a row is one of the results; returns its first and last column, None being all."""
        first, last = columns or (0, self.region.width - 1)
        self.check_pixel(row, first)
        self.check_pixel(row, last)
        if first > last:
            raise SatIntervalsError(f"columns {first} to {last} are the wrong way round: give the first one first")
        return first, last


def open_run(out: str | Path) -> Run:
    """Look at the folder of a finished run: ``intervals.tif``, ``validity.tif`` and ``run.json``; no image is needed.

    Raises
    ------
    SatIntervalsError
        No finished run, or files that do not belong together.
    """
    out = Path(out)
    file = out / "run.json"
    try:
        check_regular(file)
        which = _which(file)
        report = json.loads(file.read_text(encoding="utf-8"))
        config = load_config(report["settings"])
        for side in ("left", "right"):
            _check_input(report["inputs"][side])
        region = Window(**{name: index(report["tiles"]["region"][name]) for name in _REGION})
        told = {
            name: {key: index(file[key]) for key in ("bytes", "crc32")}
            for name, file in report.get("files", {}).items()
        }
    except OSError as error:
        raise SatIntervalsError(f"{file}: {error.strerror}: give the folder of a finished run") from error
    except SatIntervalsError as error:
        raise SatIntervalsError(f"{file}: {error}") from error
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise SatIntervalsError(f"{file} is not the report of a run: run match again with --overwrite") from error
    for name, bands in _BANDS.items():
        _check_raster(out / name, bands, region, told.get(name))
    return Run(out, report, config, region, which)


def _which(file: Path) -> tuple[int, int] | None:
    """What tells a file from one that replaces it; None where there is none."""
    with suppress(OSError):
        status = file.stat()
        return status.st_ino, status.st_mtime_ns
    return None


def _files_told(told: Any) -> Iterator[str]:
    """The paths of all files that a report tells of its inputs."""
    for value in told.values() if isinstance(told, dict) else told if isinstance(told, list) else ():
        yield from _files_told(value)
    if isinstance(told, dict) and isinstance(told.get("path"), str):
        yield told["path"]


def _check_input(told: dict[str, Any]) -> None:
    """Hold that a report tells of an image what is needed to open it again."""
    Path(told["path"])
    for name in ("band", "height", "width"):
        index(told[name])
    _nodata(told)
    if told["mask"] is not None:
        Path(told["mask"]["path"])


def _nodata(told: dict[str, Any]) -> float | None:
    return None if told["nodata"] is None else float(told["nodata"])


def _check_raster(file: Path, bands: int, region: Window, told: dict[str, int] | None) -> None:
    """Hold that a raster is there, every byte as the report of its run tells; of other versions it tells none.

    GDAL takes most flipped bits of a compressed block for pixels.
    """
    if not file.exists():
        raise SatIntervalsError(f"{file} is missing: give the folder of a finished run, or run match again")
    if told and told["bytes"] != file.stat().st_size:
        raise _damaged(file, f"has {file.stat().st_size} bytes, by run.json {told['bytes']}")
    if told and told != checksum_of(file):
        raise _damaged(file, "is not what the run published")
    found, needed = read_shape(file), (bands, region.height, region.width)
    if found != needed:
        raise SatIntervalsError(
            f"{file} has {found[0]} bands of {found[1]} x {found[2]} pixels, by run.json {needed[0]} of {needed[1]} x "
            f"{needed[2]}: run match again with --overwrite"
        )


def _damaged(file: Path, how: str) -> SatIntervalsError:
    return SatIntervalsError(
        f"{file} {how}; it is damaged or was changed: move {file.parent} away, or match again with --overwrite"
    )


def open_results(out: str | Path, truth: str | Path | None = None) -> Results:
    """Look at the folder of a finished run and at its images.

    Parameters
    ----------
    out
        Folder of ``intervals.tif``, ``validity.tif`` and ``run.json``.
    truth
        True disparity of the left image, or of the region that was matched; by default ``truth.tif`` beside the left
        image, if there is one.

    Raises
    ------
    SatIntervalsError
        No finished run, images that are no longer those it matched, or a truth of another size.
    """
    run = open_run(out)
    left, right = (_opened(run.report["inputs"][side]) for side in ("left", "right"))
    if truth is None and run.truth_beside.exists():
        truth = run.truth_beside
    layer = None if truth is None else run.layer(truth)
    return Results(run.out, run.report, run.config, run.region, run.which, left, right, layer)


def _opened(told: dict[str, Any]) -> Image:
    """An input again, as the run read it."""
    mask = told["mask"]
    image = open_image(told["path"], band=told["band"], nodata=_nodata(told), mask=mask and mask["path"])
    if (image.height, image.width) != (told["height"], told["width"]):
        raise SatIntervalsError(
            f"{image.path} has {image.height} x {image.width} pixels, when it was matched it had "
            f"{told['height']} x {told['width']}: put that image back or match again"
        )
    for file in (told, *told.get("files", ()), *([mask] if mask else [])):
        if is_changed(file["path"], file):
            raise SatIntervalsError(
                f"{file['path']} is not the file that was matched: put that image back or match again"
            )
    return image
