"""Read RPC models, and the sensor images that they belong to (shareloc)."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sat_intervals.errors import SatIntervalsError, check_file
from sat_intervals.kernels.compiled import kernels_of_others
from sat_intervals.raster import Image, find_model, read_rpc_file
from sat_intervals.tiling import Window

try:
    with kernels_of_others():
        from shareloc.geofunctions.localization import coloc
        from shareloc.geomodels import GeoModel
        from shareloc.geomodels.rpc import RPC
        from shareloc.geomodels.rpc_readers import convert_rio_rpc_to_rpc_dict
except ModuleNotFoundError as error:
    raise SatIntervalsError("sensor models need shareloc: pip install 'sat-intervals[dsm]'") from error

T = TypeVar("T")
# Half sizes of its domain by which positions and heights may be away from the middle of a model.
_DOMAIN = 1.1
# Positions along each side of an image at which the overlap is looked for.
_SAMPLES = 65
_COEFFICIENTS = "num_col", "den_col", "num_row", "den_row"
_HALVES = "scale_row", "scale_col", "scale_alt", "scale_x", "scale_y"


def read_model(path: str | Path) -> Any:
    """Read an RPC model: a raster that GDAL finds one for, a text of coefficients, ``.geom`` or DIMAP XML."""

    def read(name: str) -> Any:
        found = read_rpc_file(name)
        return GeoModel(name) if found is None else RPC(convert_rio_rpc_to_rpc_dict(found))

    return read_with(Path(path), "RPC model", read)


def read_with(path: Path, kind: str, reader: Callable[[str], T]) -> T:
    """Return what a reader makes of a file, with its errors in one line."""
    check_file(path, f"give the {kind} of the image")
    try:
        with warnings.catch_warnings(action="ignore"):
            return reader(str(path))
    except SatIntervalsError:
        raise
    except Exception as error:  # shareloc, scipy and GDAL raise many types
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SatIntervalsError(f"shareloc cannot read {path} as {kind}: {reason}") from error


@dataclass(frozen=True)
class SensorImage:
    """A raw image with its model; the origin is row and column of its first pixel's corner in the whole image."""

    image: Image
    file: str  # with the model
    model: Any
    origin: tuple[float, float]

    @classmethod
    def of(cls, image: Image, model: Path | None) -> "SensorImage":
        """Read the model of an image, given or found; raise if the image has none, or is not as the sensor took it."""
        file = str(model) if model else find_model(image.path)
        if file is None:
            raise SatIntervalsError(
                f"{image.path} has no RPC model in its tags or beside it: give --left-model and --right-model; of an "
                "epipolar image --left-grid and --right-grid, too"
            )
        read = cls(image, file, read_model(file), _origin(image))
        read._check()
        return read

    @property
    def heights(self) -> tuple[float, float]:
        """Return the lowest and the highest height of the model."""
        return self.model.offset_alt - self.model.scale_alt, self.model.offset_alt + self.model.scale_alt

    def contains(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return which positions in the whole image are on this one."""
        down, across = row - self.origin[0], column - self.origin[1]
        return (down >= 0) & (down <= self.image.height) & (across >= 0) & (across <= self.image.width)

    def check_height(self, height: float, what: str = "height") -> None:
        """Raise if a height is outside the domain of the model; ``what`` it is, for the message."""
        if abs(height - self.model.offset_alt) > _DOMAIN * self.model.scale_alt:
            lowest, highest = self.heights
            raise SatIntervalsError(
                f"{what} {height:g} m: {self.file} is for {lowest:g} to {highest:g} m above the ellipsoid: give a "
                "height in this range"
            )

    def _check(self) -> None:
        """Raise if the model has no figures, or is not that of this image."""
        numbers = [getattr(self.model, name) for name in _COEFFICIENTS]
        halves = [getattr(self.model, name) for name in _HALVES]
        if not (np.isfinite(numbers).all() and np.isfinite(halves).all() and min(halves) > 0):
            raise SatIntervalsError(f"{self.file} has coefficients or scales that are no numbers, or no scales above 0")
        model, size = self.model, (self.image.height, self.image.width)
        for name, middle, half, first, length in (
            ("rows", model.offset_row, model.scale_row, self.origin[0], size[0]),
            ("columns", model.offset_col, model.scale_col, self.origin[1], size[1]),
        ):
            if max(abs(first - middle), abs(first + length - middle)) > _DOMAIN * half:
                raise SatIntervalsError(
                    f"{self.file} is for {name} {middle - half:.0f} to {middle + half:.0f}, {self.image.path} has "
                    f"{name} {first:.0f} to {first + length:.0f}: give the model of this image; of a crop, the "
                    "geotransform must have its place in the whole image"
                )


def _origin(image: Image) -> tuple[float, float]:
    place = image.georeferencing
    if place.transform is None:
        return 0.0, 0.0
    a, b, column, d, e, row = place.transform[:6]
    if place.crs is not None or not np.allclose((a, b, d, e), (1, 0, 0, 1), rtol=0, atol=1e-9):
        what = place.crs.to_string() if place.crs else f"pixels of {a:g} x {e:g}"
        raise SatIntervalsError(
            f"{image.path} is on a map ({what}), as ortho-ready products are: give the image as the sensor took it"
        )
    return row, column


def shares_at(left: SensorImage, right: SensorImage, heights: np.ndarray) -> np.ndarray:
    """Return the shares of the left image that the right one shows at some heights ``(n,)`` in metres."""
    rows, columns = _spread(left)
    each = np.tile(rows, heights.size), np.tile(columns, heights.size), heights.repeat(rows.size)
    there = _in_right(left, right, each[0], each[1], each[2])
    return np.asarray(right.contains(there[:, 0], there[:, 1]).reshape(heights.size, -1).mean(axis=1))


def common_parts(
    left: SensorImage, right: SensorImage, elevation: Any, beyond: int
) -> tuple[float, tuple[Window, Window] | None]:
    """Return the share of the left image that the right one shows, and the parts of both that do; None without any.

    Parts are grown by ``beyond`` pixels inside the images. ``elevation``: a height in metres, or shareloc's DEM.
    """
    rows, columns = _spread(left)
    there = _in_right(left, right, rows, columns, elevation)
    inside = right.contains(there[:, 0], there[:, 1])
    if not inside.any():
        return 0.0, None
    between = beyond + max(left.image.height, left.image.width) // (_SAMPLES - 1) + 1
    left_part = _part(left, np.stack([rows, columns], axis=1)[inside], between)
    return float(inside.mean()), (left_part, _part(right, there[inside, :2], between))


def _spread(of: SensorImage) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns spread over an image, with its borders."""
    ends = zip(of.origin, (of.image.height, of.image.width), strict=True)
    rows, columns = np.meshgrid(*(first + np.linspace(0, size, _SAMPLES) for first, size in ends), indexing="ij")
    return rows.ravel(), columns.ravel()


def _in_right(left: SensorImage, right: SensorImage, rows: np.ndarray, columns: np.ndarray, elevation: Any) -> Any:
    with warnings.catch_warnings(action="ignore"):
        return coloc(left.model, right.model, rows, columns, elevation)[0]


def _part(of: SensorImage, places: np.ndarray, beyond: int) -> Window:
    """Return the part of an image around rows and columns in the whole image, ``(n, 2)``."""
    places = places - of.origin
    around = Window.around(places.min(axis=0), places.max(axis=0)).grown(beyond, beyond)
    return around.clipped(Window(0, 0, of.image.height, of.image.width))
