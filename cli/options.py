"""Options shared by commands, and checks of file names."""

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.logs import logged

if TYPE_CHECKING:
    from sat_intervals.raster import Image

# Copied from `sat_intervals.config`, which --help must not import.
COSTS = ("census", "mccnn")
PRESETS = ("paper", "satellite", "satellite-mccnn", "urban", "mountain", "homogeneous", "mccnn")

Command = Callable[..., Any]


def named(context: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    """Raise if a file name is empty, as from an unset shell variable, or not UTF-8, which GDAL needs."""
    if value == "":
        raise click.BadParameter("it is empty: give a file or folder")
    try:
        (value or "").encode()
    except UnicodeEncodeError as error:
        raise click.BadParameter(f"{value!r} is not UTF-8: rename it") from error
    return value


def path(context: click.Context, parameter: click.Parameter, value: str | None) -> Path | None:
    """Convert a name to a path; an empty name, which would be the current folder, is refused."""
    return None if value is None else Path(str(named(context, parameter, value)))


quiet_option = click.option("--quiet", "-q", is_flag=True, help="Print errors only.")
preset_option = click.option(
    "--preset",
    type=click.Choice(PRESETS),
    help="Settings for what is left out: satellite for satellite images, satellite-mccnn for different dates or little "
    "texture, paper (default) for the paper's figures.",
)
cost_option = click.option("--cost", type=click.Choice(COSTS), help="Matching cost, with its default penalties.")
store_option = click.option(
    "--store", callback=named, metavar="URL", help="Folder or fsspec URL for tiles during the run."
)
local_option = click.option(
    "--local-range", is_flag=True, help="Search a range of its own in each cell of the image, found from the images."
)
grid_option = click.option(
    "--range-grid", callback=named, metavar="FILE", help="Raster of two bands, minimum and maximum of each pixel."
)
disparity_option = click.option(
    "--disparity",
    type=int,
    nargs=2,
    metavar="MIN MAX",
    help="Search range in pixels, both ends searched; default: found from the images.",
)


_SENSOR_OPTIONS = tuple(
    click.option(f"--{side}-{kind}", required=True, callback=path, metavar="FILE", help=text.format(side))
    for kind, text in (("model", "RPC model of the {} sensor image."), ("grid", "Epipolar grid of the {} image."))
    for side in ("left", "right")
)


def sensor_options(command: Command) -> Command:
    """Add options for models and grids; the command gets ``sensor_files``, in this order."""

    @wraps(command)
    def with_sensors(*, left_model: Path, right_model: Path, left_grid: Path, right_grid: Path, **others: Any) -> Any:
        return command(sensor_files=(left_model, right_model, left_grid, right_grid), **others)

    return _with(with_sensors, *_SENSOR_OPTIONS)


_IMAGE_OPTIONS = (
    click.option("--left-mask", callback=named, metavar="FILE", help="Mask of the left image: non-zero = masked."),
    click.option("--right-mask", callback=named, metavar="FILE", help="Mask of the right image."),
    click.option("--nodata", type=float, metavar="V", help="No-data value of both images, replaces that of the files."),
    click.option("--left-nodata", type=float, metavar="V", help="No-data value of the left image."),
    click.option("--right-nodata", type=float, metavar="V", help="No-data value of the right image."),
    click.option("--band", type=int, metavar="N", help="Band to match in both images, required if they have several."),
    click.option("--left-band", type=int, metavar="N", help="Band of the left image."),
    click.option("--right-band", type=int, metavar="N", help="Band of the right image."),
    click.option(
        "--window", type=int, nargs=4, metavar="ROW COL HEIGHT WIDTH", help="Region of the left image to match."
    ),
)
# Their parameters without the window.
_OF_IMAGES = tuple(f"{side}{what}" for what in ("nodata", "band") for side in ("", "left_", "right_"))
_OF_IMAGES += ("left_mask", "right_mask")


class _Overlap(click.ParamType):  # type: ignore[type-arg,unused-ignore]
    """``exact`` or a number of pixels."""

    name = "exact|PIXELS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        try:
            return "exact" if value == "exact" else int(value)
        except ValueError:
            self.fail(f"{value!r} is neither exact nor a number of pixels: give exact, or 100", param, ctx)


_OF_SETTINGS = ("preset", "cost", "coverage", "calibration", "tile_size", "overlap", "workers", "cluster", "store")
_SETTINGS_OPTIONS = (
    click.option(
        "--config", "config_file", callback=path, metavar="FILE", help="Settings (YAML); the command line wins."
    ),
    preset_option,
    cost_option,
    click.option(
        "--coverage",
        type=float,
        metavar="C",
        help="Share of true disparities to be inside, .5 to .99, instead of alpha.",
    ),
    click.option(
        "--calibration", callback=named, metavar="FILE", help="Calibration for --coverage; default the built-in one."
    ),
    click.option("--tile-size", type=int, help="Side of a tile's core in pixels, a multiple of 64."),
    click.option(
        "--overlap", type=_Overlap(), help="exact (default): no result depends on the tiles; or pixels around a core."
    ),
    click.option("--workers", type=click.IntRange(min=1), help="Tiles at once; default one per core."),
    click.option(
        "--cluster",
        metavar="SPEC",
        help="threads (default), processes, slurm, pbs, lsf, sge, or the address of a dask scheduler.",
    ),
    store_option,
)


def image_options(command: Command) -> Command:
    """Add options for reading the images of a pair.

    The command gets ``open_images``, a function that opens both images, and ``window``, the region of the left image or
    None.
    """

    @wraps(command)
    def with_images(*, window: tuple[int, int, int, int] | None, **given: Any) -> Any:
        from sat_intervals.tiling import Window

        of_images = {name: given.pop(name) for name in _OF_IMAGES}

        def open_images(left: str, right: str) -> "tuple[Image, Image]":
            return _opened(left, "left", of_images), _opened(right, "right", of_images)

        return command(open_images=open_images, window=Window(*window) if window else None, **given)

    return _with(with_images, *_IMAGE_OPTIONS)


def _opened(file: str, side: str, given: Mapping[str, Any]) -> "Image":
    """Open the image of one side; options of the side win over those of both."""
    from sat_intervals.raster import open_image

    own = {name: given[f"{side}_{name}"] for name in ("band", "nodata")}
    both = {name: given[name] if value is None else value for name, value in own.items()}
    return open_image(file, **both, mask=given[f"{side}_mask"])


def settings_options(command: Command) -> Command:
    """Add options for settings; the command gets ``config_file`` and ``given``, the sections of the command line."""

    @wraps(command)
    def with_settings(**others: Any) -> Any:
        of = {name: others.pop(name) for name in _OF_SETTINGS}
        cluster, preset = of["cluster"], of["preset"]
        is_address = cluster is not None and "://" in cluster
        sections: dict[str, dict[str, Any]] = {
            "cost": {"method": of["cost"]},
            "interval": {"coverage": of["coverage"], "calibration": of["calibration"]},
            "tiles": {"size": of["tile_size"], "overlap": of["overlap"]},
            "cluster": {
                "workers": of["workers"],
                "kind": "address" if is_address else cluster,
                "address": cluster if is_address else None,
                "store": of["store"],
            },
        }
        set_keys = {
            name: {key: value for key, value in section.items() if value is not None}
            for name, section in sections.items()
        }
        given: dict[str, Any] = {name: section for name, section in set_keys.items() if section}
        return command(given=given | ({"preset": preset} if preset else {}), **others)

    return _with(with_settings, *_SETTINGS_OPTIONS)


def run_options(command: Command) -> Command:
    """Add options of commands that match pairs."""
    return _with(
        command,
        click.option("--strict", is_flag=True, help="End with status 1 if the run warns, as of a narrow search range."),
        click.option("--keep-tiles", is_flag=True, help="Keep the raw products of the tiles."),
        click.option("--overwrite", is_flag=True, help="Replace the run in OUT and delete its tiles."),
        quiet_option,
        log_options,
    )


def log_options(command: Command) -> Command:
    """Add options that show and save the log."""

    @wraps(command)
    def with_log(*, debug: bool, log_file: Path | None, **others: Any) -> Any:
        with logged(debug, log_file):
            return command(**others)

    return _with(
        with_log,
        click.option("--debug", is_flag=True, help="Show the complete log, and tracebacks of errors."),
        click.option("--log-file", callback=path, metavar="FILE", help="Append the complete log to FILE."),
    )


def with_range(
    given: dict[str, Any], disparity: tuple[int, int] | None, local_range: bool = False, range_grid: str | None = None
) -> dict[str, Any]:
    """Add the search range and the local ranges of the command line to its sections."""
    section: dict[str, Any] = dict(zip(("minimum", "maximum"), disparity or (), strict=False))
    if local_range:
        section["local"] = True
    if range_grid is not None:
        section["grid"] = range_grid
    return {**given, "disparity": section} if section else given


def check_strict(strict: bool, warnings: Sequence[str]) -> None:
    """Raise if a run has warned and must not.

    Raises
    ------
    RunError
        With the number of warnings; their lines have been printed.
    """
    if strict and warnings:
        from sat_intervals.errors import RunError

        count = "1 warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
        raise RunError(f"{count}, see above, and --strict is given; the files are written")


def _with(command: Command, *options: Callable[[Command], Command]) -> Command:
    for option in reversed(options):
        command = option(command)
    return command
