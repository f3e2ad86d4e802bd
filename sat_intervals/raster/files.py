"""Metadata of the files of a run, from the tables of `sat_intervals.products`."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from math import nan

from rasterio.io import DatasetWriter

from sat_intervals.products import (
    BANDS,
    CHANGE,
    FLAGS,
    FLAGS_OF_SWEEP,
    INVALID,
    POINTS,
    RANGES,
    SURFACE,
    SURFACE_OF_SWEEP,
    TRUTH,
    Band,
    Flag,
    interval_bands,
)


@dataclass(frozen=True)
class File:
    """Properties of a file: name, type, bands, further tags of its first band, predictor, GDAL driver, compression."""

    name: str
    dtype: str
    nodata: float | None
    bands: tuple[Band, ...]
    tags: Mapping[str, str] = field(default_factory=dict)
    predictor: str = "NO"
    driver: str = "COG"
    compression: str = "deflate"

    @property
    def is_of_heights(self) -> bool:
        """Return whether its first band is metres: then its CRS is vertical, too."""
        return self.bands[0].unit == "m"

    def describe(self, dataset: DatasetWriter, tags: Mapping[str, str]) -> None:
        """Write tags, and names, units and meanings of the bands."""
        dataset.update_tags(**tags)
        for index, band in enumerate(self.bands, start=1):
            dataset.set_band_description(index, band.name)
            dataset.update_tags(index, meaning=band.meaning)
            if band.unit:
                dataset.set_band_unit(index, band.unit)
        dataset.update_tags(1, **self.tags)


def _flag_tags(flags: tuple[Flag, ...]) -> dict[str, str]:
    """Return the meaning of every bit: ``bit_08 = occlusion (invalid): rejected by cross-checking: occlusion``."""
    return {
        f"bit_{flag.bit:02}": f"{flag.name}{' (invalid)' if flag.invalid else ''}: {flag.meaning}" for flag in flags
    }


_VALIDITY = Band("validity", "", f"sum of bits; a pixel is valid where (validity & {INVALID}) == 0")

INTERVALS = File("intervals.tif", "float32", nan, BANDS)
VALIDITY = File("validity.tif", "uint16", None, (_VALIDITY,), _flag_tags(FLAGS))
RUN_FILES = (INTERVALS, VALIDITY)


def run_files(compression: str, extra: Collection[str] = (), *, of_heights: bool = False) -> tuple[File, File]:
    """Return the files of a run with the compression of the settings, and with extra bands, see `interval_bands`."""
    if of_heights:
        surface = replace(surface_file("dsm.tif"), compression=compression, bands=SURFACE_OF_SWEEP)
        return surface, replace(VALIDITY, compression=compression, tags=_flag_tags(FLAGS_OF_SWEEP))
    intervals = replace(INTERVALS, compression=compression, bands=interval_bands(extra))
    return intervals, replace(VALIDITY, compression=compression)


# Files by name: points, surface models, changes of height, true disparities, local search ranges.
points_file = partial(File, dtype="float64", nodata=nan, bands=POINTS, predictor="FLOATING_POINT")
surface_file = partial(File, dtype="float32", nodata=nan, bands=SURFACE)
change_file = partial(File, dtype="float32", nodata=nan, bands=CHANGE)
truth_file = partial(File, dtype="float32", nodata=nan, bands=TRUTH)
ranges_file = partial(File, dtype="int16", nodata=None, bands=RANGES)
