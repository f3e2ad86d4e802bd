"""Open a finished run as a lazy xarray dataset. Importing this module registers the accessor ``intervals``."""

from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import BANDS, FLAGS, INVALID, POINTS, Band, flag_attributes
from sat_intervals.raster import Georeferencing, grid_mapping, read_layers, read_tags
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import Window

_PLACE = "spatial_ref"  # the name that rioxarray and odc-geo look for


class _Layer(BackendArray):
    """One band of a file of a run, read when it is indexed."""

    def __init__(self, run: Run, name: str, band: int, dtype: str) -> None:
        self.run, self.name, self.band = run, name, band
        self.shape, self.dtype = run.shape, np.dtype(dtype)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._read)

    def _read(self, key: tuple[int | slice, ...]) -> np.ndarray:
        """Read whole numbers or slices of rows and columns."""
        ranges = [
            range(size)[part] if isinstance(part, slice) else range(part, part + 1)
            for part, size in zip(key, self.shape, strict=True)
        ]
        dropped = tuple(slice(None) if isinstance(part, slice) else 0 for part in key)
        if 0 in map(len, ranges):
            return np.empty([len(places) for places in ranges], self.dtype)[dropped]
        first, end = zip(*((min(places), max(places) + 1) for places in ranges), strict=True)
        window = Window(first[0], first[1], end[0] - first[0], end[1] - first[1])
        pixels = read_layers(self.run.out / self.name, window, self.band)
        chosen = (np.asarray(places) - start for places, start in zip(ranges, first, strict=True))
        return np.asarray(pixels[np.ix_(*chosen)][dropped])


def open(out: str | Path, chunks: int | None = 2048) -> xr.Dataset:
    """Open a finished run as a lazy dataset: ``sat_intervals.open(out)``.

    Parameters
    ----------
    out
        Folder of the finished run. Its images are not needed.
    chunks
        Rows and columns of a dask chunk, best a multiple of 512; None for arrays that are read when they are used.

    Returns
    -------
    Dataset
        With the dimensions ``y`` and ``x``: ``disparity``, ``lower``, ``upper``, ``width`` (pixels), ``confidence`` and
        ``validity``, whose attributes list its flags; and the bands of ``points.tif`` if that is of this run. The
        coordinate ``spatial_ref`` has CRS and transform by the CF conventions. Attributes are ``finished`` and
        ``preset``. The accessor ``intervals`` has methods, see `Intervals`.

    Raises
    ------
    SatIntervalsError
        The folder is not a finished run, or a file cannot be read.
    """
    run = open_run(out)
    place = run.georeferencing
    dataset = xr.Dataset(coords=_coordinates(place, run.shape))
    dataset.attrs = {"title": "disparity with intervals", "source": "sat-intervals"} | {
        name: value
        for name, value in (("finished", run.report["finished"]), ("preset", run.config.preset))
        if value is not None
    }
    for number, band in enumerate(BANDS, start=1):
        dataset[band.name] = _variable(_Layer(run, "intervals.tif", number, "float32"), _described(band), chunks)
    dataset["validity"] = _variable(_Layer(run, "validity.tif", 1, "uint16"), flag_attributes(), chunks)
    points = run.out / "points.tif"
    if points.exists() and read_tags(points).get("RUN") == run.report["finished"]:
        for number, band in enumerate(POINTS, start=1):
            dataset[band.name] = _variable(_Layer(run, points.name, number, "float64"), _described(band), chunks)
    dataset["width"] = _width(dataset)
    for variable in dataset.data_vars.values():
        variable.encoding["grid_mapping"] = _PLACE
    return dataset


def _variable(layer: _Layer, attributes: dict[str, Any], chunks: int | None) -> xr.Variable:
    variable = xr.Variable(("y", "x"), indexing.LazilyIndexedArray(layer), attributes)
    return variable if chunks is None else variable.chunk({"y": chunks, "x": chunks})


def _described(band: Band) -> dict[str, Any]:
    return {"long_name": band.meaning} | ({"units": band.unit} if band.unit else {})


def _width(dataset: xr.Dataset) -> xr.DataArray:
    width = dataset["upper"] - dataset["lower"]
    return width.assign_attrs(long_name="width of the disparity interval", units="px")


def _coordinates(place: Georeferencing, shape: tuple[int, int]) -> dict[Hashable, Any]:
    """Return the centres of pixels, where they are a grid along the axes of the CRS, and the grid mapping."""
    coordinates: dict[Hashable, Any] = {_PLACE: ((), 0, grid_mapping(place))}
    transform = place.transform
    if transform is not None and not transform.b and not transform.d:
        units = {"units": "m"} if place.crs is not None and place.crs.is_projected else {}
        for name, start, step, count in (
            ("y", transform.f, transform.e, shape[0]),
            ("x", transform.c, transform.a, shape[1]),
        ):
            coordinates[name] = (name, start + step * (np.arange(count) + 0.5), {"axis": name.upper()} | units)
    return coordinates


def decode_flags(validity: xr.DataArray) -> xr.Dataset:
    """Decode validity flags.

    Parameters
    ----------
    validity
        The variable ``validity`` of a dataset of `open` or `match_arrays`.

    Returns
    -------
    Dataset
        A boolean variable for each flag, with its meaning as ``long_name``, and ``valid``: no flag makes it invalid.
    """
    flags = xr.Dataset({"valid": (validity & np.uint16(INVALID)) == 0})
    flags["valid"].attrs = {"long_name": "matched, and not rejected by cross-checking"}
    for flag in FLAGS:
        flags[flag.name] = ((validity & np.uint16(flag.value)) != 0).assign_attrs(long_name=flag.meaning)
    return flags


@xr.register_dataset_accessor("intervals")  # type: ignore[no-untyped-call]
class Intervals:
    """Methods of a dataset with intervals, as ``dataset.intervals``."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    def width(self) -> xr.DataArray:
        """Return the width of the intervals in pixels, NaN where there is none."""
        return _width(self._dataset)

    def flags(self) -> xr.Dataset:
        """Return the decoded validity flags, see `decode_flags`."""
        return decode_flags(self._dataset["validity"])

    def coverage(self, truth: xr.DataArray | np.ndarray) -> float:
        """Return the share of intervals of valid pixels that contain the truth, NaN if no truth is known.

        ``truth`` is the true disparity in pixels, as large as the dataset; NaN where unknown.
        """
        dataset = self._dataset
        if truth.shape != dataset["lower"].shape:
            raise SatIntervalsError(
                f"the truth has the shape {truth.shape}, the intervals {dataset['lower'].shape}: select the same part"
            )
        pixels = truth.data if isinstance(truth, xr.DataArray) else truth  # by place, not by labels
        true = xr.DataArray(pixels, dims=dataset["lower"].dims)
        lower, upper, validity = (dataset[name].drop_vars(dataset.coords) for name in ("lower", "upper", "validity"))
        judged = ((validity & np.uint16(INVALID)) == 0) & np.isfinite(true) & np.isfinite(lower)
        hits = judged & (lower <= true) & (true <= upper)
        counts = xr.Dataset({"hits": hits.sum(), "judged": judged.sum()}).compute()
        return float(counts["hits"] / counts["judged"]) if counts["judged"] else float("nan")

    def profile(self, row: int, columns: Sequence[int] | None = None) -> xr.Dataset:
        """Return one row, counted from 0 at the top, read into memory; ``columns`` are the first and the last."""
        rows, width = self._dataset["lower"].shape
        first, last = columns or (0, width - 1)
        if not (0 <= row < rows and 0 <= first <= last < width):
            raise SatIntervalsError(
                f"row {row}, columns {first} to {last} are outside the dataset: rows are 0 to {rows - 1}, columns 0 to "
                f"{width - 1}"
            )
        down, across = self._dataset["lower"].dims
        return self._dataset.isel({down: row, across: slice(first, last + 1)}).compute()
