"""Images to a surface model: of two an epipolar pair is matched and its points are gridded, more go by a sweep."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from sat_intervals.config import Interval, load_config, resolved
from sat_intervals.errors import SatIntervalsError, check_absent
from sat_intervals.heights.choices import SurfaceChoices, completion_of
from sat_intervals.heights.dsm import check_sensors, checked_cells, surface_of_runs, surface_tags
from sat_intervals.heights.geometry import geometry_warnings, set_geometry
from sat_intervals.heights.rectify import IMAGES, raw_inputs, rectified_files
from sat_intervals.match.costs import check_cost
from sat_intervals.products import ORTHO
from sat_intervals.progress import Progress
from sat_intervals.raster import Image, check_not_replaced, files_of, open_image, path_of
from sat_intervals.results import open_run
from sat_intervals.run.beside import compiled_beside
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers, pool_of
from sat_intervals.run.pair import matched_on
from sat_intervals.run.state import OUTPUTS
from sat_intervals.tiling import Window
from sat_intervals.workflows.many import Wanted, surface_of_many
from sat_intervals.workflows.rectify import rectified

# What is made of a run, in its folder.
FILES = "geometry.json", "dsm.tif", ORTHO

Rectified = Callable[[dict[str, Any]], None]
"""Called with what `rectify` returns, as soon as raw images are an epipolar pair."""


class Epipolar(NamedTuple):
    """An epipolar pair with its models and grids, and what `rectify` returned if it was made of raw images."""

    left: Image
    right: Image
    sensors: tuple[Path, ...]
    record: dict[str, Any] | None


def surface(
    images: Sequence[str | Path | Image],
    out: str | Path,
    config: Any = None,
    *,
    resolution: float | str | Path,
    crs: str | None = None,
    radius: float | None = None,
    geoid: str | Path | None = None,
    choices: SurfaceChoices | None = None,
    extent: tuple[float, float, float, float] | None = None,
    heights: tuple[float, float] | None = None,
    sensors: Sequence[str | Path | None] = (),
    dem: str | Path | None = None,
    altitude: float | None = None,
    resolution_of: str | None = None,
    window: Window | None = None,
    keep_tiles: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
    on_rectified: Rectified = lambda record: None,
) -> dict[str, Any]:
    """Make a surface model with height intervals of two images, or of three and more at once.

    Two images: `rectify`, `match_pair` and `make_surface` in one. More: images are resampled to the ground at each
    height and compared there; semi-global matching chooses the heights (METHOD.md, section 20), and the models are
    shifted to fit each other. To resume, call it again: what is finished with these images and settings is kept.

    Parameters
    ----------
    images
        Raw images with RPC models, two or more; of two, left and right, ``out`` has the epipolar pair ``left.tif``,
        ``right.tif``. Or an epipolar pair with the models and grids of its raw images. Paths, or images opened by
        `open_image`.
    out
        Folder for the files of all steps; the surface model is ``out/dsm.tif``.
    config, keep_tiles, overwrite
        As for `match_pair`; of three images or more the preset is ``many`` by default, and others need its ``cost``.
    resolution, crs, geoid
        As for `make_surface`.
    sensors
        RPC models of the images; of an epipolar pair left and right model and grid, see `set_geometry`. By default the
        models that belong to raw images, and what `rectify` has noted of its pair.
    radius, choices
        Of two images, as for `make_surface`; of more, ``choices`` may have ``calibration``, ``ortho``, ``fill``,
        ``flatten`` and ``mask``.
    dem, altitude, resolution_of
        Of two raw images, as for `rectify`; the heights of ``dem`` refer to ``geoid``.
    window
        Of an epipolar pair: region of the left image.
    extent
        Of three images or more: left, bottom, right and top of the surface on its map, metres; by default the ground
        that two images see.
    heights
        Of three images or more: lowest and highest height of the ground, metres above ``geoid`` or the ellipsoid; by
        default found.
    progress
        Callback, see `Progress`.
    on_rectified
        Called with what `rectify` returns, as soon as two raw images are an epipolar pair.

    Returns
    -------
    Of two images ``rectify``, ``run`` and ``surface``, what the three steps return, the first None of an epipolar pair;
    and ``warnings``, lines of all steps. Of more the content of ``run.json``, which has ``warnings``, too; its
    ``sweep`` has the shifts (pixels) and likeness of the images, those left out, the grid, heights and their step.

    Raises
    ------
    SatIntervalsError
        Inputs, settings or output cannot be used; models, grids and cells are checked before matching.
    RunError
        Tiles failed; no output was published.
    """
    opened = [one if isinstance(one, Image) else open_image(one) for one in images]
    config, out, geoid = load_config(config, images=len(opened)), path_of(out), path_of(geoid) if geoid else None
    resolution = path_of(resolution) if isinstance(resolution, str) else resolution
    raw: dict[str, Any] = {"dem": dem, "altitude": altitude, "resolution_of": resolution_of}
    choices = choices or SurfaceChoices()
    of_points = replace(choices, calibration=None, ortho=False, fill=None, flatten=None, mask=None) != SurfaceChoices()
    if len(opened) < 2:
        raise SatIntervalsError(f"images: {len(opened)} given, a surface needs two or more")
    how: dict[str, Any] = {"overwrite": overwrite, "keep_tiles": keep_tiles}
    if len(opened) > 2:
        check_absent(raw | {"window": window, "radius": radius, "a choice of points": of_points or None}, "two images")
        wanted = Wanted(resolution, crs, geoid, extent, heights, sensors, choices)
        return surface_of_many(opened, out, config, wanted, progress=progress, **how)
    check_absent({"extent": extent, "heights": heights}, "three images or more")
    check_cost(config)
    cells: dict[str, Any] = {"resolution": resolution, "crs": crs, "radius": radius, "geoid": geoid, "choices": choices}
    check_cells(resolved(config).interval, **cells)
    with compiled_beside(config), Connection(config.cluster, out) as connection:
        pool = pool_of(connection, out, progress)
        raw |= {"geoid": geoid if dem else None, "overwrite": overwrite}
        pair = epipolar_pair(opened, out, pool, sensors, window, on_rectified, **raw)
        if choices.ortho:
            raw_inputs(pair.left.path, pair.right.path)
        grid = files_of(str(resolution)) if isinstance(resolution, Path) else ()
        read = [file for one in opened for file in (one.path, one.mask)]
        results = [out / name for name in (*OUTPUTS, *FILES)]
        read += map(str, filter(None, (*pair.sensors, geoid, choices.flatten, choices.mask, *grid)))
        check_not_replaced(read, results, [out / "tiles"])
        check_sensors(pair.sensors, resolution, crs, choices)
        matching = EachOnWorkers(connection, progress)
        run = matched_on(matching, (pair.left, pair.right), out, config, window=window, **how)
        made = surface_of(out, pair.sensors, pool, **cells)
    doubts = pair.record["warnings"] if pair.record else []
    warnings = [*doubts, *run["warnings"], *geometry_warnings(made["geometry"])]
    return {"rectify": pair.record, "run": run, "surface": made, "warnings": warnings}


def check_cells(interval: Interval | None, *, choices: SurfaceChoices, **cells: Any) -> None:
    """Raise for cells that the surface cannot have, before hours of matching; see `surface_of`."""
    _, cell, _, radius = checked_cells(**cells)
    completion_of(cell, choices)
    surface_tags(["run"], [interval], choices.for_intervals([interval]), cell, radius)


def surface_of(out: Path, sensors: Sequence[Path], pool: EachOnWorkers, **cells: Any) -> dict[str, Any]:
    """Note the models and grids of a finished run and make its surface; ``cells`` are those of `surface_of_runs`."""
    set_geometry(out, *sensors)
    return surface_of_runs([open_run(out)], out / "dsm.tif", pool, **cells)


def has_grids(sensors: Sequence[str | Path | None] | None) -> bool:
    """Return whether there are grids beside models."""
    return len(sensors or ()) > len(IMAGES)


def epipolar_pair(
    images: Sequence[Image],
    out: Path,
    pool: EachOnWorkers,
    sensors: Sequence[str | Path | None],
    window: Window | None,
    on_rectified: Rectified,
    **raw: Any,
) -> Epipolar:
    """Return an epipolar pair with its models and grids; raw images are rectified in the folder of the run.

    ``raw`` are further arguments of `rectified`.
    """
    left, right = images
    files = (
        tuple(path_of(file) for file in sensors if file)
        if has_grids(sensors)
        else rectified_files(left.path, right.path)
    )
    if files:
        of_raw = {name: raw[name] for name in ("dem", "altitude", "resolution_of")}
        of_raw["a model without a grid"] = None if has_grids(sensors) else sensors or None
        check_absent(of_raw, f"raw images, {left.path} is an epipolar image")
        return Epipolar(left, right, files, None)
    if window:
        raise SatIntervalsError("window is a region of an epipolar image: rectify these raw images, then match them")
    raw |= dict(zip(("left_model", "right_model"), sensors or (None, None), strict=True))
    record = rectified(images, out, pool, **raw)
    on_rectified(record)
    left, right = (open_image(out / name) for name in IMAGES)
    files = rectified_files(left.path, right.path)
    assert files
    return Epipolar(left, right, files, record)
