"""Open a run or surface model as a lazy xarray dataset. Importing this module registers the accessor ``intervals``."""

from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import FLAGS, INVALID, WIDTH, flag_attributes
from sat_intervals.raster import File, Georeferencing, path_of, read_layers, read_tags, run_files, surface_file
from sat_intervals.raster.files import change_file
from sat_intervals.raster.projection import grid_mapping
from sat_intervals.raster.surfaces import read_place, surface_place
from sat_intervals.results import open_run
from sat_intervals.tiling import Window

_PLACE = "spatial_ref"  # the name that rioxarray and odc-geo look for
_SURFACE = "surface model with intervals"


class _LazyBand(BackendArray):
    """One band of a file, read when it is indexed."""

    def __init__(self, file: Path, shape: tuple[int, int], band: int, dtype: str) -> None:
        self.file, self.band = file, band
        self.shape, self.dtype = shape, np.dtype(dtype)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._read)

    def _read(self, key: tuple[int | slice, ...]) -> np.ndarray:
        """Read whole numbers or slices of rows and columns."""
        rows, columns = (np.arange(size)[part] for part, size in zip(key, self.shape, strict=True))
        shape = (*rows.shape, *columns.shape)
        if 0 in shape:
            return np.empty(shape, self.dtype)
        row, column = int(rows.min()), int(columns.min())
        window = Window(row, column, int(rows.max()) + 1 - row, int(columns.max()) + 1 - column)
        pixels = read_layers(self.file, window, self.band)
        return np.asarray(pixels[np.ix_(rows.ravel() - row, columns.ravel() - column)].reshape(shape))


def open(out: str | Path, chunks: int | None = 2048) -> xr.Dataset:
    """Open a finished run as a lazy dataset: ``sat_intervals.open(out)``.

    Parameters
    ----------
    out
        Folder of the finished run, also in a bucket (``s3://bucket/run``). Its images are not needed.
    chunks
        Rows and columns of a dask chunk, best a multiple of 512; None for arrays that are read when they are used.

    Returns
    -------
    Dataset
        With the dimensions ``y`` and ``x``: ``disparity``, ``lower``, ``upper``, ``width`` (pixels), ``confidence`` and
        ``validity``, whose attributes list its flags; of many images, the variables of `open_surface`, ``width``
        (metres) and ``validity``. The coordinate ``spatial_ref`` has CRS and transform by the CF
        conventions. Attributes are ``finished`` and ``preset``. The accessor ``intervals`` has methods, see
        `Intervals`.

    Raises
    ------
    SatIntervalsError
        The folder is not a finished run, or a file cannot be read.
    """
    run = open_run(out)
    dataset = xr.Dataset(coords=_coordinates(run.georeferencing, run.shape))
    title = _SURFACE if run.is_sweep else "disparity with intervals"
    dataset.attrs = {"title": title, "source": "sat-intervals", "finished": run.report["finished"]}
    if run.config.preset:
        dataset.attrs["preset"] = run.config.preset
    if run.is_sweep:
        dataset.attrs |= _attributes_of_surface(run.out / "dsm.tif")
    for file in run_files("", run.config.extra_bands, of_heights=run.is_sweep):
        _add_bands(dataset, file, run.out / file.name, run.shape)
    dataset["validity"].attrs = flag_attributes()
    if chunks is not None:
        dataset = dataset.chunk({"y": chunks, "x": chunks})
    dataset["width"] = dataset.intervals.width()
    dataset["width"].encoding["grid_mapping"] = _PLACE
    return dataset


def open_surface(path: str | Path, chunks: int | None = 2048) -> xr.Dataset:
    """Open a surface model, or a change, as a lazy dataset: ``sat_intervals.open_surface("out/dsm.tif")``.

    Parameters
    ----------
    path
        File that `surface` or `make_surface` has written, or ``change.tif`` of `change`.
    chunks
        Rows and columns of a dask chunk, as for `open`.

    Returns
    -------
    Dataset
        With the dimensions ``y`` and ``x``: ``height``, ``height_lower``, ``height_upper`` (metres), ``count``,
        ``confidence`` and ``agreement``, NaN where unknown. The coordinate ``spatial_ref`` has the CRS, with that of
        heights, and the transform by the CF conventions. Attributes are ``vertical_datum``, what heights are above,
        the ``coverage`` or ``alpha`` of the intervals. A change has ``difference``, its bounds, ``significance`` and
        ``change``.

    Raises
    ------
    SatIntervalsError
        The file cannot be read, or is no such file of this package.
    """
    file = path_of(path)
    changes = "FALSE_ALARMS" in read_tags(file)
    if not changes:
        surface_place(file)
    shape, place = read_place(file, is_flat=False)
    dataset = xr.Dataset(coords=_coordinates(place, shape))
    dataset.attrs = {"title": "change of height" if changes else _SURFACE, "source": "sat-intervals"}
    dataset.attrs |= _attributes_of_surface(file)
    datum = dataset.attrs["vertical_datum"]
    _add_bands(dataset, (change_file if changes else surface_file)(file.name), file, shape)
    level = "reference_ellipsoid" if datum.endswith("ellipsoid") else "geopotential_datum"
    if not changes:
        dataset["height"].attrs["standard_name"] = f"height_above_{level}"
    return dataset if chunks is None else dataset.chunk({"y": chunks, "x": chunks})


def _attributes_of_surface(file: Path) -> dict[str, Any]:
    """Return what the heights of a surface model are above, and the level of its intervals."""
    tags = read_tags(file)
    levels = {name: float(tags[name.upper()]) for name in ("coverage", "alpha") if name.upper() in tags}
    return {"vertical_datum": tags["HEIGHTS"].removeprefix("above "), **levels}


def _add_bands(dataset: xr.Dataset, file: File, path: Path, shape: tuple[int, int]) -> None:
    """Add the bands of a file as lazy variables."""
    for number, band in enumerate(file.bands, start=1):
        lazy = indexing.LazilyIndexedArray(_LazyBand(path, shape, number, file.dtype))
        attributes = {"long_name": band.meaning} | ({"units": band.unit} if band.unit else {})
        dataset[band.name] = xr.Variable(("y", "x"), lazy, attributes, {"grid_mapping": _PLACE})


def _coordinates(place: Georeferencing, shape: tuple[int, int]) -> dict[Hashable, Any]:
    """Return the centres of pixels, where they are a grid along the axes of the CRS, and the grid mapping."""
    coordinates: dict[Hashable, Any] = {_PLACE: ((), 0, grid_mapping(place))}
    if place.transform is not None and not place.transform.b and not place.transform.d:
        units = {"units": "m"} if place.crs is not None and place.crs.is_projected else {}
        starts, steps = (place.transform.f, place.transform.c), (place.transform.e, place.transform.a)
        for name, start, step, count in zip("yx", starts, steps, shape, strict=True):
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
        """Return the width of the intervals in pixels, or in metres of heights; NaN where there is none."""
        lower, upper = self._bounds()
        name = WIDTH if lower.name == "lower" else "width of the height's interval"
        return (upper - lower).assign_attrs(long_name=name, units="px" if lower.name == "lower" else "m")

    def _bounds(self) -> tuple[xr.DataArray, xr.DataArray]:
        start = "" if "lower" in self._dataset else "height_"
        return self._dataset[f"{start}lower"], self._dataset[f"{start}upper"]

    def flags(self) -> xr.Dataset:
        """Return the decoded validity flags, see `decode_flags`."""
        return decode_flags(self._dataset["validity"])

    def coverage(self, truth: xr.DataArray | np.ndarray) -> float:
        """Return the share of intervals of valid pixels that contain the truth, NaN if no truth is known.

        ``truth`` is the true disparity in pixels, or height in metres, as large as the dataset; NaN where unknown.
        """
        lower, upper, validity = (one.variable for one in (*self._bounds(), self._dataset["validity"]))
        if truth.shape != lower.shape:
            sizes = f"the truth has the shape {truth.shape}, the intervals {lower.shape}"
            raise SatIntervalsError(f"{sizes}: select the same part")
        true = xr.Variable(lower.dims, truth.data if isinstance(truth, xr.DataArray) else truth)
        judged = ((validity & np.uint16(INVALID)) == 0) & np.isfinite(true) & np.isfinite(lower)
        hits = judged & (lower <= true) & (true <= upper)
        counts = xr.Dataset({"hits": hits.sum(), "judged": judged.sum()}).compute()
        return float(counts["hits"] / counts["judged"]) if counts["judged"] else float("nan")

    def profile(self, row: int, columns: Sequence[int] | None = None) -> xr.Dataset:
        """Return one row, counted from 0 at the top, read into memory; ``columns`` are the first and the last."""
        lower, _ = self._bounds()
        rows, width = lower.shape
        first, last = columns or (0, width - 1)
        if not (0 <= row < rows and 0 <= first <= last < width):
            part = f"row {row}, columns {first} to {last} are outside the dataset"
            raise SatIntervalsError(f"{part}: rows are 0 to {rows - 1}, columns 0 to {width - 1}")
        down, across = lower.dims
        return self._dataset.isel({down: row, across: slice(first, last + 1)}).compute()
