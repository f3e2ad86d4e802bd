"""Read RPC models, and the sensor images that they belong to (shareloc)."""

import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from sat_intervals.errors import SatIntervalsError, check_file
from sat_intervals.kernels.compiled import kernels_of_others
from sat_intervals.raster import Image, between_180, find_model, path_of, read_rpc_file
from sat_intervals.raster.identity import local_file
from sat_intervals.raster.rpc import local_copy
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
_DOMAIN = 1.1  # half sizes of its domain by which positions and heights may be away from the middle of a model
_SAMPLES = 65  # positions along each side of an image at which the overlap is looked for
# Heights that are tried.
_LEVELS = 64
_COEFFICIENTS = "num_col", "den_col", "num_row", "den_row"
_HALVES = "scale_row", "scale_col", "scale_alt", "scale_x", "scale_y"

_LOG = logging.getLogger(__name__)


def read_model(path: str | Path) -> Any:
    """Read an RPC model: a raster that GDAL finds one for, a text of coefficients, ``.geom`` or DIMAP XML."""

    def read(name: str) -> Any:
        if found := read_rpc_file(name):
            return RPC(convert_rio_rpc_to_rpc_dict(found))
        with TemporaryDirectory() as folder:
            return GeoModel(local_copy(name, folder))

    model = read_with(path_of(path), "RPC model", read)
    if abs(model.offset_x) > 180:  # GDAL takes 245 E for 115 W, shareloc does not
        model.offset_x = between_180(model.offset_x)
    return model


def read_with(path: Path, kind: str, reader: Callable[[str], T]) -> T:
    """Return what a reader makes of a file, with its errors in one line."""
    check_file(local_file(str(path)) or path, f"give the {kind} of the image")
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
    def readings(cls, image: Image, model: Path | None) -> "list[SensorImage]":
        """Return the image with its model, given or found, for each place that may be meant; raise if none fits."""
        file = str(model) if model else find_model(image.path)
        if file is None:
            raise SatIntervalsError(
                f"{image.path} has no RPC model in its tags or beside it: give --left-model and --right-model; of an "
                "epipolar image --left-grid and --right-grid, too"
            )
        read = read_model(file)
        found = [cls(image, file, read, origin) for origin in _origins(image, has_tags=file == image.path)]
        if fitting := [one for one in found if not one._misfit()]:
            return fitting
        raise SatIntervalsError(str(found[-1]._misfit()))

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

    def _misfit(self) -> str | None:
        """Say why the model is not that of this image: it projects its box of ground elsewhere; None if it fits."""
        model = self.model
        numbers = [getattr(model, name) for name in _COEFFICIENTS]
        halves = [getattr(model, name) for name in _HALVES]
        if not (np.isfinite(numbers).all() and np.isfinite(halves).all() and min(halves) > 0):
            return f"{self.file} has coefficients or scales that are no numbers, or no scales above 0"
        x, y, height = (axis.ravel() for axis in np.meshgrid(*3 * [[-1.0, 1.0]]))
        ground = model.offset_x + x * model.scale_x, model.offset_y + y * model.scale_y
        there = model.inverse_loc(*ground, model.offset_alt + height * model.scale_alt)
        sizes = self.image.height, self.image.width
        for name, places, first, size in zip(("rows", "columns"), there[:2], self.origin, sizes, strict=True):
            lowest, highest = places.min(), places.max()
            more = (_DOMAIN - 1) / 2 * (highest - lowest)
            if not lowest - more <= first <= first + size <= highest + more:
                return (
                    f"{self.file} is for {name} {lowest:.0f} to {highest:.0f}, {self.image.path} has {name} "
                    f"{first:.0f} to {first + size:.0f}: give the model of this image; of a crop, the geotransform "
                    "must have its place in the whole image"
                )
        return None


def _origins(image: Image, *, has_tags: bool) -> list[tuple[float, float]]:
    """Return the places of an image in the whole one, by its geotransform: RPC tags of a crop may be of either."""
    own, place = (0.0, 0.0), image.georeferencing
    if place.transform is None:
        return [own]
    a, b, column, d, e, row = place.transform[:6]
    if place.crs is None and np.allclose((a, b, d, abs(e)), (1, 0, 0, 1), rtol=0, atol=1e-9):
        there = row if e > 0 else max(0.0, -row), column  # QGIS and world files have -y for rows
        return [own, there] if has_tags and there != own else [there]
    what = place.crs.to_string() if place.crs else f"pixels of {a:g} x {e:g}"
    if has_tags and place.crs and place.crs.is_geographic:  # of NITF: its corners, to a second of arc
        _LOG.warning("%s: its rough place on the map (%s) is ignored, its RPC tags are taken", image.path, what)
        return [own]
    raise SatIntervalsError(
        f"{image.path} is on a map ({what}), as ortho-ready products are: give the image as the sensor took it"
    )


def common_heights(left: SensorImage, right: SensorImage) -> np.ndarray:
    """Return heights in the domain of both models, ``(64,)`` metres."""
    lowest, highest = max(left.heights[0], right.heights[0]), min(left.heights[1], right.heights[1])
    return np.linspace(lowest, max(lowest, highest), _LEVELS)


def common_parts(
    left: SensorImage, right: SensorImage, elevation: Any, beyond: int
) -> tuple[np.ndarray, tuple[Window, Window] | None]:
    """Return the shares of the left image that the right one shows, and these parts, grown; None without any.

    ``elevation``: heights in metres ``(n,)``, which give n shares, or one height, or shareloc's DEM.
    """
    ends = zip(left.origin, (left.image.height, left.image.width), strict=True)
    places = np.meshgrid(*(first + np.linspace(0, size, _SAMPLES) for first, size in ends), indexing="ij")
    rows, columns = (np.tile(axis.ravel(), np.size(elevation)) for axis in places)
    if isinstance(elevation, np.ndarray):
        elevation = elevation.repeat(_SAMPLES**2)
    with warnings.catch_warnings(action="ignore"):
        there = coloc(left.model, right.model, rows, columns, elevation)[0]
    inside = right.contains(there[:, 0], there[:, 1])
    shares = inside.reshape(-1, _SAMPLES**2).mean(axis=1)
    if not inside.any():
        return shares, None
    between = beyond + max(left.image.height, left.image.width) // (_SAMPLES - 1) + 1
    left_part = _part(left, np.stack([rows, columns], axis=1)[inside], between)
    return shares, (left_part, _part(right, there[inside, :2], between))


def _part(of: SensorImage, places: np.ndarray, beyond: int) -> Window:
    """Return the part of an image around rows and columns in the whole image, ``(n, 2)``."""
    places = places - of.origin
    around = Window.around(places.min(axis=0), places.max(axis=0)).grown(beyond, beyond)
    return around.clipped(Window(0, 0, of.image.height, of.image.width))
