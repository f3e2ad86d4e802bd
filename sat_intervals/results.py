"""A finished run as its folder holds it: what it says of itself, its bands, its images, and a truth beside them."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.config import Config, Regularization, load_config
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.confidence import low_confidence
from sat_intervals.raster import Image, open_image, read_layers, read_small_image, read_small_layers, read_window
from sat_intervals.tiling import Window

# Rows read at a time: a row of the blocks that runs write.
_STRIP_ROWS = 512


class Bands(NamedTuple):
    """What a run wrote of some pixels, all ``(rows, columns)``, with the left image and the truth.

    Attributes
    ----------
    disparity, lower, upper
        float32 pixels, NaN for none.
    confidence
        float32, 0 to 1, NaN for none.
    validity
        uint16 flags.
    image
        Grey values of the left image, floats, NaN where there is no data.
    truth
        True disparity in pixels, floats, NaN where it is not known.
    """

    disparity: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    confidence: np.ndarray
    validity: np.ndarray
    image: np.ndarray
    truth: np.ndarray

    def low(self, config: Config) -> np.ndarray:
        """Pixels of low confidence (paper eq. 12 and 13); the bands must be of whole rows.

        Where the run did not regularise, by the default settings of regularisation.
        """
        settings = config.regularization or Regularization()
        return np.asarray(low_confidence(self.confidence, settings.threshold, settings.kernel))


@dataclass(frozen=True)
class Results:
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
    left, right
        The images.
    truth
        True disparity, None without; of the size of the region or of the left image.
    """

    out: Path
    report: dict[str, Any]
    config: Config
    region: Window
    left: Image
    right: Image
    truth: Image | None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the results."""
        return self.region.height, self.region.width

    def read(self, window: Window) -> Bands:
        """Everything of the pixels of a window of the results."""
        disparity, lower, upper, confidence = read_layers(self.out / "intervals.tif", window)
        validity = read_layers(self.out / "validity.tif", window)[0]
        image = _values(self.left, self._in_left(window))
        return Bands(disparity, lower, upper, confidence, validity, image, self._read_truth(window))

    def read_pixel(self, row: int, column: int) -> Bands:
        """Everything of one pixel, as arrays of no dimension."""
        self.check_pixel(row, column)
        return Bands(*(band[0, 0] for band in self.read(Window(row, column, 1, 1))))

    def strips(self) -> Iterator[tuple[int, Bands]]:
        """Everything, strip by strip from the top, with the first row of each."""
        for row in range(0, self.region.height, _STRIP_ROWS):
            yield row, self.read(Window(row, 0, min(_STRIP_ROWS, self.region.height - row), self.region.width))

    def read_small(self, shape: tuple[int, int]) -> Bands:
        """All of the results but the truth, as ``shape`` pixels: the bands picked, the left image averaged."""
        disparity, lower, upper, confidence = read_small_layers(self.out / "intervals.tif", shape)
        validity = read_small_layers(self.out / "validity.tif", shape)[0]
        image = read_small_image(self.left, self.region, shape)
        return Bands(disparity, lower, upper, confidence, validity, image, np.full(shape, np.nan))

    def read_small_left(self, window: Window, shape: tuple[int, int]) -> np.ndarray:
        """The left image under a window of the results, as ``shape`` pixels."""
        return read_small_image(self.left, self._in_left(window), shape)

    def check_pixel(self, row: int, column: int) -> None:
        """Hold that a pixel is one of the results."""
        height, width = self.shape
        if not (0 <= row < height and 0 <= column < width):
            raise SatIntervalsError(
                f"row {row}, column {column} is outside the results in {self.out}: "
                f"rows are 0 to {height - 1}, columns 0 to {width - 1}"
            )

    def _in_left(self, window: Window) -> Window:
        row, column = self.region.row + window.row, self.region.column + window.column
        return Window(row, column, window.height, window.width)

    def _read_truth(self, window: Window) -> np.ndarray:
        if self.truth is None:
            return np.full((window.height, window.width), np.nan)
        of_region = (self.truth.height, self.truth.width) == self.shape
        return _values(self.truth, window if of_region else self._in_left(window))


def open_results(out: str | Path, truth: str | Path | None = None) -> Results:
    """Look at the folder of a finished run.

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
        No finished run, images that are no longer there, or a truth of another size.
    """
    out = Path(out)
    file = out / "run.json"
    try:
        report = json.loads(file.read_text(encoding="utf-8"))
        config = load_config(report["settings"])
        region = Window(**report["tiles"]["region"])
        left, right = (_opened(report["inputs"][side]) for side in ("left", "right"))
    except OSError as error:
        raise SatIntervalsError(f"{file}: {error.strerror}: give the folder of a finished run") from error
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise SatIntervalsError(f"{file} is not the report of a run: run match again with --overwrite") from error
    return Results(out, report, config, region, left, right, _opened_truth(truth, left, region))


def _opened(described: dict[str, Any]) -> Image:
    """An input again, as the run read it."""
    mask, nodata = described["mask"], described["nodata"]
    image = open_image(
        described["path"],
        band=described["band"],
        nodata=None if nodata is None else float(nodata),
        mask=mask and mask["path"],
    )
    if (image.height, image.width) != (described["height"], described["width"]):
        raise SatIntervalsError(
            f"{image.path} has {image.height} x {image.width} pixels, when it was matched it had "
            f"{described['height']} x {described['width']}: put that image back or match again"
        )
    return image


def _opened_truth(path: str | Path | None, left: Image, region: Window) -> Image | None:
    beside = Path(left.path).parent / "truth.tif"
    if path is None and not beside.exists():
        return None
    truth = open_image(beside if path is None else path)
    sizes = (region.height, region.width), (left.height, left.width)
    if (truth.height, truth.width) not in sizes:
        raise SatIntervalsError(
            f"{truth.path} has {truth.height} x {truth.width} pixels, the left image {left.height} x {left.width} and "
            f"the run {region.height} x {region.width}: give a truth of one of these sizes with --truth"
        )
    return truth


def _values(image: Image, window: Window) -> np.ndarray:
    pixels, state = read_window(image, window)
    return np.where(state == 0, pixels, np.nan)
