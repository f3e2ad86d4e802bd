"""Export a run to the file formats of other photogrammetry tools.

All define disparity as ``x_right - x_left``, as here, and none uses a CRS. The files have the size of the left image;
pixels outside the matched region are invalid. Those for OTB keep the transform of the left image.
"""

from math import nan
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import Band
from sat_intervals.raster import File, Georeferencing, OutputWriter, check_free, path_of
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import Window, strips

_STRIP = 1 << 22  # pixels


class Raster(NamedTuple):
    """A file of layers, see `_read`, its value of invalid pixels (of a mask: valid ones), and the settings it needs."""

    name: str
    layers: tuple[str, ...]
    invalid: float = 0
    section: str = ""
    valid: int | None = None

    def file(self, prefix: str) -> File:
        """Return the properties of the file; ``prefix`` is that of its name."""
        bands = tuple(Band(layer, "", layer) for layer in self.layers)
        driver = "PNG" if self.name.endswith(".png") else "COG"
        dtype = "float32" if self.valid is None else "uint8"
        return File(prefix + self.name, dtype, self.invalid or None, bands, driver=driver)

    def bands(self, layers: dict[str, np.ndarray]) -> np.ndarray:
        """Return the bands of the file, ``(bands, rows, columns)``."""
        stacked = np.stack([layers[name] for name in self.layers])
        return np.nan_to_num(stacked, nan=self.invalid) if self.valid is None else self.valid * stacked


FORMATS = {
    # CARS 1.3
    "cars": (
        Raster("epi_disp.tif", ("disparity",), -9999),
        Raster("epi_disp_interval_bounds_inf.tif", ("lower",), -9999, "interval"),
        Raster("epi_disp_interval_bounds_sup.tif", ("upper",), -9999, "interval"),
        Raster("epi_disp_ambiguity.tif", ("ambiguity",), -9999, "ambiguity"),
        Raster("epi_disp_mask.tif", ("valid",), valid=255),
    ),
    # DisparityMapToElevationMap: -io.in and -io.mask
    "otb": (Raster("disparity.tif", ("horizontal", "vertical")), Raster("mask.tif", ("valid",), valid=255)),
    # parallel_stereo --entry-point 5, not run with it
    "asp": (Raster("-F.tif", ("horizontal", "vertical", "valid")),),
    # after matching a tile
    "s2p": (
        Raster("rectified_disp.tif", ("disparity",), nan),
        Raster("rectified_mask.png", ("valid",), valid=1),
        Raster("rectified_disp_confidence.tif", ("confidence",), nan, "ambiguity"),
    ),
}


def export(out: str | Path, form: str, target: str | Path, *, overwrite: bool = False) -> list[Path]:
    """Write a run in one of FORMATS to a folder, and return the files; a band that the run lacks has no file.

    For ``asp`` the target is the prefix of the file, such as ``stereo/run`` of ``stereo/run-F.tif``.
    """
    run, target = open_run(out), path_of(target)
    run.check_pair()
    left = run.report["inputs"]["left"]
    shape = left["height"], left["width"]
    folder, prefix = (target.parent, target.name) if form == "asp" else (target, "")
    if form == "asp" and (target.is_dir() or not target.name):
        raise SatIntervalsError(f"{target} is a folder: give a prefix for ASP's file, such as {target / 'run'}")
    rasters = [raster for raster in FORMATS[form] if not raster.section or getattr(run.config, raster.section)]
    files = [raster.file(prefix) for raster in rasters]
    paths = [folder / file.name for file in files]
    run.check_kept(paths)
    for path in paths:
        check_free(path, overwrite=overwrite)
    place = Georeferencing(transform=run.left_georeferencing.transform if form == "otb" else None)
    with OutputWriter(folder, files, *shape, place, {"SOFTWARE": "sat-intervals", "EXPORT": form}) as writer:
        for window in strips(*shape, _STRIP):
            layers = _read(run, window)
            writer.write(window.row, *(raster.bands(layers) for raster in rasters))
        writer.publish()
    return paths


def _read(run: Run, window: Window) -> dict[str, np.ndarray]:
    """Read the layers of a window of the left image; NaN where invalid or outside the run's region."""
    pixels = np.full((4, window.height, window.width), np.nan, np.float32)
    inside = window.clipped(run.region)
    if inside.height:
        bands = run.read_bands(inside.relative_to(run.region))
        valid = bands.valid & np.isfinite(bands.disparity)
        pixels[:, *inside.relative_to(window).slices] = np.where(valid, bands[:4], np.float32(np.nan))
    disparity, lower, upper, confidence = pixels
    vertical, valid = np.zeros_like(disparity), np.isfinite(disparity)
    layers = {"disparity": disparity, "lower": lower, "upper": upper, "confidence": confidence, "valid": valid}
    return layers | {"ambiguity": 1 - confidence, "horizontal": disparity, "vertical": vertical}
