"""A volume of another matcher as it is given: its forms, and what its values mean."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from sat_intervals.config import ConfigError
from sat_intervals.match.volume import unmasked

# Names of dimensions, lower case.
_DISPARITY = {"disp", "disparity", "disparities", "d"}
_ROW = {"row", "rows", "y"}
_COLUMN = {"col", "column", "x"}
_FEWEST = 3
# Of disparities that count as evenly spaced, relative to their step.
_TOLERANCE = 1e-5


@dataclass(frozen=True)
class ExternalVolume:
    """A volume of another matcher.

    values: ``(rows, columns, disparities)``, not finite where a candidate is impossible.
    disparities: of the candidates in pixels, float64, evenly spaced.
    labels: an array of its pixels, with coordinates.
    kind, lowest, highest: what values mean, and their smallest and largest possible one.
    """

    values: np.ndarray
    disparities: np.ndarray
    labels: xr.DataArray
    kind: str
    lowest: float
    highest: float

    @property
    def shape(self) -> tuple[int, int, int]:
        """Return rows, columns, disparities."""
        rows, columns, count = self.values.shape
        return rows, columns, count

    @property
    def first(self) -> float:
        """Return the first disparity in pixels."""
        return float(self.disparities[0])

    @property
    def step(self) -> float:
        """Return the distance of candidates in pixels."""
        return round(float(np.ptp(self.disparities)) / (self.disparities.size - 1), 9)

    @property
    def first_index(self) -> int:
        """Return the first disparity as the kernels count candidates; 0 if they are no whole pixels, as a range is."""
        is_whole = self.step == 1 and abs(self.first - round(self.first)) < _TOLERANCE
        return round(self.first) if is_whole else 0

    @property
    def whole_pixels(self) -> tuple[int, int]:
        """Return every how many candidates, and from which on, disparities are whole pixels; ``(0, 0)`` for none."""
        whole = np.flatnonzero(np.abs(self.disparities - np.rint(self.disparities)) < _TOLERANCE)
        every = int(whole[1] - whole[0]) if whole.size > 1 else 0
        return (every, int(whole[0])) if every and abs(every * self.step - 1) < _TOLERANCE else (0, 0)

    @property
    def cost(self) -> dict[str, Any]:
        """Return the section ``cost`` of the settings."""
        if self.kind == "probability":
            return {"method": "volume", "kind": self.kind}
        span = float(f"{self.highest - self.lowest:.9g}")
        return {"method": "volume", "kind": self.kind, "span": span, "lowest": self.lowest}


def open_external(volume: Any, disparities: Any, kind: str | None, span: Any) -> ExternalVolume:
    """Check what describes a volume; see `intervals_of`."""
    attributes: dict[str, Any] = {}
    if isinstance(volume, xr.Dataset):
        if "cost_volume" not in volume:
            raise ConfigError(f"the dataset has {', '.join(map(str, volume.data_vars))}, but no cost_volume")
        volume = volume["cost_volume"].assign_attrs(volume.attrs)
    if isinstance(volume, xr.DataArray):
        attributes = volume.attrs
        volume, axis = _in_order(volume)
        if disparities is None and axis in volume.coords:
            disparities = volume.coords[axis].data
        names = zip("yx", volume.dims, strict=False)
        coordinates = {new: volume.coords[old].data for new, old in names if old in volume.coords}
        values = volume.data
    else:
        values, coordinates = np.asanyarray(volume), {}
    values = unmasked(values)
    if values.ndim != 3 or values.dtype.kind not in "uif" or 0 in values.shape:
        raise ConfigError(f"the volume is {values.shape} of {values.dtype}: give rows, columns, disparities of numbers")
    kind = kind or {"min": "cost", "max": "similarity"}.get(attributes.get("type_measure", ""))
    if kind not in ("cost", "similarity", "probability"):
        raise ConfigError(f"kind is {kind}: give cost, similarity or probability")
    labels = xr.DataArray(np.empty(values.shape[:2], np.bool_), coordinates, ("y", "x"))
    ends = _ends(kind, span, attributes.get("cmax"))
    return ExternalVolume(values, _spaced(disparities, values.shape[2]), labels, kind, *ends)


def _in_order(volume: xr.DataArray) -> tuple[xr.DataArray, Hashable]:
    """Return a volume as rows, columns, disparities, and the name of its disparities."""
    lower = {dim: str(dim).lower() for dim in volume.dims}
    axes = [dim for dim in volume.dims if lower[dim] in _DISPARITY]
    others = [dim for dim in volume.dims if dim not in axes]
    if len(axes) != 1 or len(others) != 2:
        raise ConfigError(f"the volume has dimensions {', '.join(map(str, volume.dims))}: give row, col and disp")
    if lower[others[0]] in _COLUMN or lower[others[1]] in _ROW:
        others.reverse()
    return volume.transpose(*others, *axes), axes[0]


def _spaced(disparities: Sequence[float] | None, count: int) -> np.ndarray:
    """Return the disparities of the candidates; raise unless they are as many, and evenly spaced."""
    if disparities is None:
        raise ConfigError("disparities are missing: give those of the candidates, in pixels")
    found = np.asarray(disparities)
    if found.dtype.kind not in "uif":
        raise ConfigError(f"disparities are {found.dtype}: give numbers, in pixels")
    found = found.astype(np.float64)
    if found.shape != (count,):
        raise ConfigError(f"{found.size} disparities are given, but the volume has {count} candidates")
    if count < _FEWEST:
        raise ConfigError(f"the volume has {count} disparities, at least {_FEWEST} are needed")
    steps = np.diff(found)
    if not (steps > 0).all() or np.ptp(steps) > _TOLERANCE * steps[0]:
        raise ConfigError(f"disparities are {found[0]:g}, {found[1]:g} .. {found[-1]:g}: give ascending, even steps")
    return found


def _ends(kind: str, span: Any, largest: float | None) -> tuple[float, float]:
    """Return the smallest and the largest possible value."""
    if kind == "probability":
        if span not in (None, 1):
            raise ConfigError(f"span is {span}, but that of probabilities is 1: leave it out")
        return 0.0, 1.0
    if span is None:
        raise ConfigError("span is missing: give the largest possible value minus the smallest")
    if np.size(span) > 2:
        raise ConfigError(f"span is {span}: give a number, or the smallest and the largest possible value")
    low, high = (0.0, float(span)) if np.ndim(span) == 0 else map(float, span)
    if kind == "similarity" and largest is not None and np.ndim(span) == 0:
        low, high = float(largest) - high, float(largest)
    if not 0 < high - low < np.inf:
        raise ConfigError(f"span is {span}: give a positive number, or the smallest and the largest possible value")
    return low, high
