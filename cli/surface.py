"""``sat-intervals surface``: from two epipolar images to a surface model in one command."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.dsm import calibration_option, cell_options, say_surface
from sat_intervals.cli.matching import (
    PairArguments,
    RunArguments,
    SettingsArguments,
    pair_options,
    run_options,
    search_options,
)
from sat_intervals.cli.options import FILE, SensorFiles, json_option, note_geometry, say_json, sensor_options
from sat_intervals.cli.rectify import raw_options, rectified
from sat_intervals.cli.triangulate import geometry_warnings

if TYPE_CHECKING:
    from sat_intervals.cli.console import Console
    from sat_intervals.config import Interval
    from sat_intervals.config.pairs import PairOfBatch
    from sat_intervals.run.batch import Begin, Finish

# What is made of a run, in its folder.
_FILES = "geometry.json", "dsm.tif"


@click.command(short_help="Match a pair and make a surface model.")
@search_options
@pair_options
@click.argument("out", type=FILE)
@partial(sensor_options, models_alone=True)
@raw_options
@cell_options
@calibration_option("--height-calibration")
@json_option
@run_options
def surface(
    pair: PairArguments,
    out: Path,
    sensor_files: list[tuple[Path, ...]],
    raw: dict[str, Any],
    cells: dict[str, Any],
    as_json: bool,
    settings: SettingsArguments,
    run: RunArguments,
) -> None:
    """Match the images LEFT and RIGHT and write the surface model to OUT/dsm.tif.

    LEFT and RIGHT are raw images with RPC models, or an epipolar pair with the models and grids of its raw images. Raw
    images become the epipolar pair OUT/left.tif, OUT/right.tif, as by `rectify`; heights of --dem refer to --geoid.

    The same as `rectify`, `match` and `dsm`, with their options and files. To resume, rerun the same command: what is
    finished with these images and settings is kept, the surface is made again.
    """
    from sat_intervals.cli.console import Console

    if len(sensor_files) > 1:
        raise click.UsageError("give --left-model, --right-model, --left-grid and --right-grid once.")
    config = settings.load()
    with Console(run.quiet or as_json) as console:
        from sat_intervals.config import resolved
        from sat_intervals.heights.dsm import check_sensors

        _check(cells, resolved(config).interval)
        raw |= {"geoid": cells["geoid"] if raw["dem"] else None}
        given, images = sensor_files[0] if sensor_files else (), pair.files
        pair, files, doubts = _epipolar(pair, given, raw, out, console, overwrite=run.overwrite)
        _check_kept(out, cells, [*files, *images], settings.file)
        check_sensors(files, cells["resolution"], cells["crs"])
        left, right = pair.open()
        report = run.match(left, right, out, config, window=pair.window, progress=console.progress)
        made = _surface(out, files, cells, console)
    if as_json:
        say_json({"run": report, "surface": made})
    console.summary(report, out)
    say_surface(console, made)
    console.say(str(out / "dsm.tif"))
    run.check_strict([*doubts, *report["warnings"], *geometry_warnings(made["geometry"])])


def _epipolar(
    pair: PairArguments,
    given: Sequence[Path],
    raw: dict[str, Any],
    out: Path,
    console: "Console",
    *,
    overwrite: bool,
) -> tuple[PairArguments, SensorFiles, list[str]]:
    """Return an epipolar pair, models and grids, and warnings; raw images are rectified in the folder of the run."""
    from sat_intervals.heights.rectified import IMAGES, rectified_files

    has_grids = len(given) > len(IMAGES)
    if made := (given[0], given[1], given[2], given[3]) if has_grids else rectified_files(*pair.images):
        options = {"--left-model without --left-grid": given and not has_grids}
        options |= {
            f"--{name.replace('_', '-')}": raw[name] is not None for name in ("dem", "altitude", "resolution_of")
        }
        for name in (name for name, is_given in options.items() if is_given):
            raise click.UsageError(f"{name} is for raw images, {pair.images[0]} is an epipolar image: leave it out.")
        return pair, made, []
    if pair.window:
        raise click.UsageError("--window is a region of an epipolar image: rectify these raw images, then match them.")
    record = rectified(pair, out, tuple(given) or (None, None), raw, overwrite=overwrite, console=console, rows=False)
    left, right = (str(out / name) for name in IMAGES)
    made = rectified_files(left, right)
    assert made
    return PairArguments((left, right), (None, None), (None, None), (None, None), None), made, record["warnings"]


def _check_kept(
    out: Path, cells: dict[str, Any], sensor_files: Sequence[str | Path], config: Path | None = None
) -> None:
    """Raise if a step would write over a file that is read."""
    from sat_intervals.raster import files_of
    from sat_intervals.raster.identity import check_not_replaced
    from sat_intervals.run.state import OUTPUTS

    results = [out / name for name in (*OUTPUTS, *_FILES)]
    grid = cells["resolution"]
    read = [cells["geoid"], *(files_of(str(grid)) if isinstance(grid, (str, Path)) else ())]
    check_not_replaced([config, *sensor_files, *read], results, [out / "tiles"])


def _check_kept_by_all(pairs: "Sequence[PairOfBatch]", out: Path) -> None:
    """Raise if the surface of a pair would replace an input of another one."""
    from sat_intervals.raster.identity import check_not_replaced

    images = [file for pair in pairs for file in (pair.left, pair.right, pair.left_mask, pair.right_mask)]
    sensors = [file for pair in pairs for file in pair.sensors or ()]
    check_not_replaced(
        [*images, *sensors], [out / pair.name / name for pair in pairs if pair.resolution for name in _FILES]
    )


def _surface(out: Path, sensor_files: SensorFiles, cells: dict[str, Any], console: "Console") -> dict[str, Any]:
    """Make the surface of a finished run; return its report."""
    from sat_intervals.heights.dsm import make_surface

    note_geometry([out], [sensor_files])
    return make_surface([out], out / "dsm.tif", **cells, progress=console.progress)


def _check(cells: dict[str, Any], interval: "Interval | None") -> None:
    """Raise for cells that the surface cannot have, before hours of matching."""
    from sat_intervals.heights.dsm import checked_cells, surface_tags

    _, cell, _, radius = checked_cells(*(cells[name] for name in ("resolution", "crs", "radius", "geoid")))
    surface_tags(["run"], [interval], cells["choices"].for_intervals([interval]), cell, radius)


def surfaces_of(pairs: "Sequence[PairOfBatch]", out: Path, console: "Console") -> "Finish":
    """Return a function that makes the surface model of a pair of a batch, if its row asks for one.

    Models and grids are read now, before hours of matching. Those that cannot be used fail their pair, at its end.
    """
    from sat_intervals.errors import SatIntervalsError
    from sat_intervals.heights.choices import SurfaceChoices

    cells = {"crs": None, "radius": None, "geoid": None, "choices": SurfaceChoices()}
    errors: dict[str, SatIntervalsError] = {}
    if any(pair.resolution for pair in pairs):
        import sat_intervals.heights.sensors  # noqa: F401 (without its extra it raises, for all pairs)
        from sat_intervals.heights.dsm import check_sensors
    _check_kept_by_all(pairs, out)
    for pair in pairs:
        if not pair.resolution:
            continue
        of_pair = {"resolution": pair.resolution, **cells}
        _check_kept(out / pair.name, of_pair, pair.sensors or ())
        try:
            _check(of_pair, None)
            if pair.sensors and _has_grids(pair):
                check_sensors(pair.sensors, pair.resolution, None)
        except SatIntervalsError as error:
            errors[pair.name] = error
            click.echo(f"{pair.name}: there will be no surface: {error}", err=True)

    def surface_of(pair: "PairOfBatch", finished: str) -> dict[str, Any]:
        if not pair.resolution:
            return {}
        if pair.name in errors:
            raise errors[pair.name]
        of_pair = {"resolution": pair.resolution, **cells}
        return {"surface": _surface(out / pair.name, pair.sensors, of_pair, console)}

    return surface_of


def _has_grids(pair: "PairOfBatch") -> bool:
    return len(pair.sensors or ()) > 2


def epipolar_pairs(out: Path, console: "Console", doubts: list[str], *, overwrite: bool) -> "Begin":
    """Return a function that makes the epipolar pair of a pair of a batch for a surface, and adds to its ``doubts``."""
    from sat_intervals.tiling import Window

    def epipolar(pair: "PairOfBatch") -> "PairOfBatch":
        if not pair.resolution or _has_grids(pair):
            return pair
        from sat_intervals.heights.dsm import check_sensors

        kinds = (
            (pair.reading.get(f"{side}_{what}", pair.reading.get(what)) for side in ("left", "right"))
            for what in ("nodata", "band")
        )
        nodata, band = map(tuple, kinds)
        window = Window(*pair.window) if pair.window else None
        images = PairArguments((pair.left, pair.right), (pair.left_mask, pair.right_mask), nodata, band, window)
        raw = {"dem": None, "altitude": None, "geoid": None, "resolution_of": None}
        given = tuple(map(Path, pair.sensors or ()))
        made, files, found = _epipolar(images, given, raw, out / pair.name, console, overwrite=overwrite)
        doubts.extend(found)
        check_sensors(files, pair.resolution, None)
        names = dict(zip(("left", "right", "left_mask", "right_mask"), (*made.images, *made.masks), strict=True))
        reading = pair.reading if made is images else {}
        return replace(pair, **names, reading=reading, sensors=tuple(map(str, files)))

    return epipolar
