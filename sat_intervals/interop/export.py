"""Export a run to the file formats of other photogrammetry tools.

All define disparity as ``x_right - x_left``, as here, and none uses a CRS. The files have the size of the left image;
pixels outside the matched region are invalid. Those for OTB keep the transform of the left image.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sat_intervals.config import Config
from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import LEFT_WINDOW, Band, Bands
from sat_intervals.raster import File, Georeferencing, OutputWriter
from sat_intervals.raster.publishing import check_free
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import Window, strips

# Pixels of a strip.
_STRIP = 1 << 22

Raster = tuple[File, Callable[[Bands], np.ndarray]]
"""A file and a function from the bands of a run to its bands. NaN (invalid) becomes the file's no-data value if any."""


def _file(name: str, *bands: str, dtype: str = "float32", nodata: float | None = None, driver: str = "COG") -> File:
    described = tuple(Band(band, "", band) for band in bands)
    return File(name, dtype, nodata, described, driver=driver)


def _two(horizontal: np.ndarray, *more: np.ndarray) -> np.ndarray:
    """Stack the horizontal disparity, a vertical disparity of zero, and ``more``."""
    return np.stack([horizontal, np.zeros_like(horizontal), *more])


def _cars(prefix: str, config: Config) -> list[Raster]:
    """Return the files of CARS 1.3: 255 = valid in the mask, -9999 = no data in the others."""
    bounds: list[Raster] = [
        (_file("epi_disp_interval_bounds_inf.tif", "lower", nodata=-9999), lambda pixels: pixels.lower),
        (_file("epi_disp_interval_bounds_sup.tif", "upper", nodata=-9999), lambda pixels: pixels.upper),
    ]
    ambiguity: Raster = (
        _file("epi_disp_ambiguity.tif", "ambiguity", nodata=-9999),
        lambda pixels: 1 - pixels.confidence,
    )
    return [
        (_file("epi_disp.tif", "disparity", nodata=-9999), lambda pixels: pixels.disparity),
        *(bounds if config.interval else []),
        *([ambiguity] if config.ambiguity else []),
        (_file("epi_disp_mask.tif", "valid", dtype="uint8"), lambda pixels: 255 * pixels.valid),
    ]


def _asp(prefix: str, config: Config) -> list[Raster]:
    """Return the input of ``parallel_stereo --entry-point 5``, not run with it: horizontal, vertical, 1 = valid."""
    file = _file(f"{prefix}-F.tif", "horizontal", "vertical", "valid")
    return [(file, lambda pixels: _two(np.nan_to_num(pixels.disparity), pixels.valid))]


def _s2p(prefix: str, config: Config) -> list[Raster]:
    """Return the files of s2p after matching a tile, not run with it: NaN = no disparity, 1 = valid in the mask."""
    confidence: Raster = (
        _file("rectified_disp_confidence.tif", "confidence", nodata=float("nan")),
        lambda pixels: pixels.confidence,
    )
    return [
        (_file("rectified_disp.tif", "disparity", nodata=float("nan")), lambda pixels: pixels.disparity),
        (_file("rectified_mask.png", "valid", dtype="uint8", driver="PNG"), lambda pixels: pixels.valid),
        *([confidence] if config.ambiguity else []),
    ]


def _otb(prefix: str, config: Config) -> list[Raster]:
    """Return the input of OTB's DisparityMapToElevationMap: ``-io.in`` (horizontal, vertical), ``-io.mask``."""
    return [
        (_file("disparity.tif", "horizontal", "vertical"), lambda pixels: _two(np.nan_to_num(pixels.disparity))),
        (_file("mask.tif", "valid", dtype="uint8"), lambda pixels: 255 * pixels.valid),
    ]


FORMATS: dict[str, Callable[[str, Config], list[Raster]]] = {"cars": _cars, "otb": _otb, "asp": _asp, "s2p": _s2p}


def export(out: str | Path, form: str, target: str | Path, *, overwrite: bool = False) -> list[Path]:
    """Write a run in one of FORMATS to a folder, and return the files; a band that the run lacks has no file.

    For ``asp`` the target is the prefix of the file, such as ``stereo/run`` of ``stereo/run-F.tif``.
    """
    run, target = open_run(out), Path(target)
    left = run.report["inputs"]["left"]
    shape = left["height"], left["width"]
    folder, prefix = (target.parent, target.name) if form == "asp" else (target, "")
    if form == "asp" and (target.is_dir() or not target.name):
        raise SatIntervalsError(f"{target} is a folder: give a prefix for ASP's file, such as {target / 'run'}")
    rasters = FORMATS[form](prefix, run.config)
    files = [file for file, _ in rasters]
    paths = [folder / file.name for file in files]
    run.check_kept(paths, [run.out / "points.tif"])
    for path in paths:
        check_free(path, overwrite=overwrite)
    place = Georeferencing(transform=run.left_georeferencing.transform if form == "otb" else None)
    with OutputWriter(folder, files, *shape, place, {"SOFTWARE": "sat-intervals", "EXPORT": form}) as writer:
        for window in strips(*shape, _STRIP):
            pixels = _read(run, window)
            writer.write(window.row, *(_filled(make(pixels), file) for file, make in rasters))
        writer.publish()
    return paths


def _read(run: Run, window: Window) -> Bands:
    """Read a window of the left image; pixels outside the run's region are invalid."""
    pixels = np.full((4, window.height, window.width), np.nan, np.float32)
    inside = window.clipped(run.region)
    if inside.height:
        bands = run.read_bands(inside.relative_to(run.region))
        valid = bands.valid & np.isfinite(bands.disparity)
        pixels[:, *inside.relative_to(window).slices] = np.where(valid, bands[:4], np.float32(np.nan))
    disparity, lower, upper, confidence = pixels
    return Bands(disparity, lower, upper, confidence, np.where(np.isfinite(disparity), 0, LEFT_WINDOW))


def _filled(bands: np.ndarray, file: File) -> np.ndarray:
    return bands if file.nodata is None else np.where(np.isnan(bands), file.nodata, bands)
