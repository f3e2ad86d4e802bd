"""Options that many commands have, and how names of files are taken."""

from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.logs import logged

if TYPE_CHECKING:
    from sat_intervals.raster import Image

COSTS = ("census", "mccnn")
# As of `sat_intervals.config`, which help does not wait for.
PRESETS = ("paper", "satellite", "satellite-mccnn", "urban", "mountain", "homogeneous", "mccnn")

Command = Callable[..., Any]


def named(context: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    """Refuse names that the shell makes of a variable that is not set, and those that GDAL cannot be told."""
    if value == "":
        raise click.BadParameter("it is empty: name a file or folder")
    try:
        (value or "").encode()
    except UnicodeEncodeError as error:
        raise click.BadParameter(f"{value!r} is no UTF-8: rename it") from error
    return value


def path(context: click.Context, parameter: click.Parameter, value: str | None) -> Path | None:
    """Make a path of a name: one of an empty name would be the current folder."""
    return None if value is None else Path(str(named(context, parameter, value)))


quiet_option = click.option("--quiet", is_flag=True, help="Print errors only.")
preset_option = click.option(
    "--preset",
    type=click.Choice(PRESETS),
    help="Settings that fill in what is left out: satellite for satellite images, satellite-mccnn for different dates "
    "or little texture, paper (default) for the paper's figures.",
)
cost_option = click.option("--cost", type=click.Choice(COSTS), help="Matching cost; its penalties come with it.")
store_option = click.option(
    "--store", callback=named, metavar="URL", help="Folder or fsspec URL for tiles until the run is finished."
)
disparity_option = click.option(
    "--disparity", type=int, nargs=2, metavar="MIN MAX", help="Search range in pixels, both ends searched."
)


_IMAGE_OPTIONS = (
    click.option("--left-mask", callback=named, metavar="FILE", help="Left pixels to leave out: non-zero = masked."),
    click.option("--right-mask", callback=named, metavar="FILE", help="Right pixels to leave out."),
    click.option("--nodata", type=float, metavar="V", help="No-data value of both images, in place of their own."),
    click.option("--left-nodata", type=float, metavar="V", help="No-data value of the left image."),
    click.option("--right-nodata", type=float, metavar="V", help="No-data value of the right image."),
    click.option("--band", type=int, metavar="N", help="Band to match of both images, needed where they have several."),
    click.option("--left-band", type=int, metavar="N", help="Band of the left image."),
    click.option("--right-band", type=int, metavar="N", help="Band of the right image."),
    click.option(
        "--window", type=int, nargs=4, metavar="ROW COL HEIGHT WIDTH", help="Region of the left image to match."
    ),
)
# What they give beside the window.
_OF_IMAGES = tuple(f"{side}{what}" for what in ("nodata", "band") for side in ("", "left_", "right_"))
_OF_IMAGES += ("left_mask", "right_mask")
_SETTINGS_OPTIONS = (
    click.option(
        "--config", "config_file", callback=path, metavar="FILE", help="Settings (YAML); the command line wins."
    ),
    preset_option,
    cost_option,
    click.option("--tile-size", type=int, help="Side of a tile's core in pixels, a multiple of 64."),
    click.option("--overlap", type=int, help="Pixels read around a core."),
    click.option("--workers", type=click.IntRange(min=1), help="Tiles in work at once; default one a core."),
    click.option(
        "--cluster",
        metavar="SPEC",
        help="threads (default), processes, slurm, pbs, lsf, sge, or the address of a dask scheduler.",
    ),
    store_option,
)


def image_options(command: Command) -> Command:
    """Options that say how the images of a pair are read; a command gets ``images``, which opens both of them.

    It gets ``window`` as well, the region of the left image, or None.
    """

    @wraps(command)
    def with_images(*, window: tuple[int, int, int, int] | None, **given: Any) -> Any:
        from sat_intervals.tiling import Window

        of_images = {name: given.pop(name) for name in _OF_IMAGES}

        def images(left: str, right: str) -> "tuple[Image, Image]":
            return _opened(left, "left", of_images), _opened(right, "right", of_images)

        return command(images=images, window=Window(*window) if window else None, **given)

    return _with(with_images, *_IMAGE_OPTIONS)


def _opened(file: str, side: str, given: Mapping[str, Any]) -> "Image":
    """The image of one side; an option of the side wins over that of both."""
    from sat_intervals.raster import open_image

    own = {name: given[f"{side}_{name}"] for name in ("band", "nodata")}
    both = {name: given[name] if value is None else value for name, value in own.items()}
    return open_image(file, **both, mask=given[f"{side}_mask"])


def settings_options(command: Command) -> Command:
    """Options that give settings; a command gets ``config_file`` and ``given``, the sections of the command line."""

    @wraps(command)
    def with_settings(
        *,
        preset: str | None,
        cost: str | None,
        tile_size: int | None,
        overlap: int | None,
        workers: int | None,
        cluster: str | None,
        store: str | None,
        **others: Any,
    ) -> Any:
        is_address = cluster is not None and "://" in cluster
        sections: dict[str, dict[str, Any]] = {
            "cost": {"method": cost},
            "tiles": {"size": tile_size, "overlap": overlap},
            "cluster": {
                "workers": workers,
                "kind": "address" if is_address else cluster,
                "address": cluster if is_address else None,
                "store": store,
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
    """Options of a command that makes runs."""
    return _with(
        command,
        click.option("--keep-tiles", is_flag=True, help="Keep the raw products of the tiles."),
        click.option("--overwrite", is_flag=True, help="Replace the run in OUT and drop its tiles."),
        quiet_option,
        log_options,
    )


def log_options(command: Command) -> Command:
    """Options that show and keep what is logged while the command is at work."""

    @wraps(command)
    def with_log(*, debug: bool, log_file: Path | None, **others: Any) -> Any:
        with logged(debug, log_file):
            return command(**others)

    return _with(
        with_log,
        click.option("--debug", is_flag=True, help="Show all that is done, and tracebacks of errors."),
        click.option("--log-file", callback=path, metavar="FILE", help="Add to FILE all that --debug shows."),
    )


def with_range(given: dict[str, Any], disparity: tuple[int, int] | None) -> dict[str, Any]:
    """Sections of the command line with its search range, if there is one."""
    return (
        given
        if disparity is None
        else {**given, "disparity": dict(zip(("minimum", "maximum"), disparity, strict=True))}
    )


def _with(command: Command, *options: Callable[[Command], Command]) -> Command:
    for option in reversed(options):
        command = option(command)
    return command
