"""Options shared by the commands that match: the pair, its settings, the run."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import (
    FILE,
    NAME,
    Command,
    cost_option,
    log_options,
    preset_option,
    quiet_option,
    store_option,
    with_options,
)

if TYPE_CHECKING:
    from sat_intervals.config import Config
    from sat_intervals.raster import Image
    from sat_intervals.tiling import Window


@dataclass(frozen=True)
class PairArguments:
    """Two epipolar images, the options that say how to read them, and the region of the left one to match."""

    left: str
    right: str
    options: Mapping[str, Any]
    window: "Window | None"

    @property
    def files(self) -> list[str]:
        """Return images and masks."""
        return [self.left, self.right, *filter(None, (self.options["left_mask"], self.options["right_mask"]))]

    def open(self) -> "tuple[Image, Image]":
        """Open both images; options of one side win over those of both."""
        return self._opened(self.left, "left"), self._opened(self.right, "right")

    def _opened(self, file: str, side: str) -> "Image":
        from sat_intervals.raster import open_image

        own = {name: self.options[f"{side}_{name}"] for name in ("band", "nodata")}
        both = {name: self.options[name] if value is None else value for name, value in own.items()}
        return open_image(file, **both, mask=self.options[f"{side}_mask"])


@dataclass(frozen=True)
class SettingsArguments:
    """A file of settings, and the sections of the command line, which win over it; names of the options given."""

    file: Path | None
    sections: dict[str, Any]
    options: tuple[str, ...] = ()

    def load(self, **sections: Any) -> "Config":
        """Load the settings; the sections given here win."""
        from sat_intervals.config import load_config

        return load_config(self.file, self.sections | sections)


@dataclass(frozen=True)
class RunArguments:
    """How a run treats the tiles and files of its folder, and what it prints."""

    keep_tiles: bool
    overwrite: bool
    strict: bool
    quiet: bool

    def match(
        self, left: "Image | Path", right: "Image | Path", out: Path, config: "Config", **more: Any
    ) -> dict[str, Any]:
        """Match a pair to the folder ``out``; ``more`` are arguments of `match_pair`."""
        from sat_intervals.run.pair import match_pair

        return match_pair(left, right, out, config, keep_tiles=self.keep_tiles, overwrite=self.overwrite, **more)

    def check_strict(self, warnings: Sequence[str]) -> None:
        """Raise if the run has warned and must not.

        Raises
        ------
        RunError
            With the number of warnings; their lines have been printed.
        """
        if self.strict and warnings:
            from sat_intervals.errors import RunError

            count = "1 warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
            raise RunError(f"{count}, see above, and --strict is given; the files are written")


_IMAGE_OPTIONS = (
    click.option("--left-mask", type=NAME, help="Mask of the left image: non-zero = masked."),
    click.option("--right-mask", type=NAME, help="Mask of the right image."),
    click.option("--nodata", type=float, metavar="V", help="No-data value of both images, replaces that of the files."),
    click.option("--left-nodata", type=float, metavar="V", help="No-data value of the left image."),
    click.option("--right-nodata", type=float, metavar="V", help="No-data value of the right image."),
    click.option("--band", type=int, metavar="N", help="Band to match in both images, required if they have several."),
    click.option("--left-band", type=int, metavar="N", help="Band of the left image."),
    click.option("--right-band", type=int, metavar="N", help="Band of the right image."),
)
_OF_IMAGES = ("left_mask", "right_mask", "nodata", "left_nodata", "right_nodata", "band", "left_band", "right_band")


def pair_options(command: Command) -> Command:
    """Add the arguments LEFT and RIGHT, and options to read them; the command gets ``pair``, a `PairArguments`."""

    @wraps(command)
    def with_pair(*, left: str, right: str, window: tuple[int, int, int, int] | None, **others: Any) -> Any:
        from sat_intervals.tiling import Window

        of_images = {name: others.pop(name) for name in _OF_IMAGES}
        return command(pair=PairArguments(left, right, of_images, Window(*window) if window else None), **others)

    return with_options(
        with_pair,
        click.argument("left", type=NAME),
        click.argument("right", type=NAME),
        *_IMAGE_OPTIONS,
        click.option(
            "--window", type=int, nargs=4, metavar="ROW COL HEIGHT WIDTH", help="Region of the left image to match."
        ),
    )


class _Overlap(click.ParamType):  # type: ignore[type-arg,unused-ignore]
    """``exact`` or a number of pixels."""

    name = "exact|PIXELS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        try:
            return "exact" if value == "exact" else int(value)
        except ValueError:
            self.fail(f"{value!r} is neither exact nor a number of pixels: give exact, or 100", param, ctx)


local_option = click.option(
    "--local-range", is_flag=True, help="Search a separate range in each cell of the image, found from the images."
)
_SEARCH_OPTIONS = (
    click.option(
        "--disparity",
        type=int,
        nargs=2,
        metavar="MIN MAX",
        help="Search range in pixels, both ends searched; default: found from the images.",
    ),
    local_option,
    click.option("--range-grid", type=NAME, help="Raster of two bands, minimum and maximum of each pixel."),
)
_LEVEL_OPTIONS = (
    click.option(
        "--coverage",
        type=float,
        metavar="C",
        help="Share of true disparities to be inside, .5 to .99, instead of alpha.",
    ),
    click.option("--calibration", type=NAME, help="Calibration for --coverage; default the built-in one."),
)
_FIRST_SETTINGS = (
    click.option("--config", "config_file", type=FILE, help="Settings (YAML); the command line wins."),
    preset_option,
    cost_option,
)
_LAST_SETTINGS = (
    click.option("--tile-size", type=int, help="Side of a tile's core in pixels, a multiple of 64."),
    click.option(
        "--overlap",
        type=_Overlap(),
        help="exact (default): results do not depend on the tiles; or a number of pixels read around each tile, with "
        "results that depend on them slightly.",
    ),
    click.option("--workers", type=click.IntRange(min=1), help="Tiles at once; default one per core."),
    click.option(
        "--cluster",
        metavar="SPEC",
        help="threads (default), processes, slurm, pbs, lsf, sge, or the address of a dask scheduler.",
    ),
    store_option,
)


# Section and key of the options that are settings as they stand.
_PLACES = {
    "cost": ("cost", "method"),
    "coverage": ("interval", "coverage"),
    "calibration": ("interval", "calibration"),
    "tile_size": ("tiles", "size"),
    "overlap": ("tiles", "overlap"),
    "workers": ("cluster", "workers"),
    "store": ("cluster", "store"),
}


def settings_options(command: Command, levels: Sequence[Callable[[Command], Command]] = _LEVEL_OPTIONS) -> Command:
    """Add options for settings; the command gets ``settings``, a `SettingsArguments`.

    ``levels`` are the options --coverage and --calibration, where they mean something else than in `match`.
    """

    @wraps(command)
    def with_settings(*, config_file: Path | None, preset: str | None, cluster: str | None, **others: Any) -> Any:
        sections: dict[str, Any] = {"preset": preset} if preset else {}
        given = {"config": config_file, "preset": preset, "cluster": cluster} | {name: others[name] for name in _PLACES}
        names = tuple(f"--{name.replace('_', '-')}" for name, value in given.items() if value is not None)
        for option, (section, key) in _PLACES.items():
            if (value := others.pop(option)) is not None:
                sections.setdefault(section, {})[key] = value
        if cluster:
            is_address = "://" in cluster
            chosen = {"kind": "address", "address": cluster} if is_address else {"kind": cluster}
            sections["cluster"] = sections.get("cluster", {}) | chosen
        return command(settings=SettingsArguments(config_file, sections, names), **others)

    return with_options(with_settings, *_FIRST_SETTINGS, *levels, *_LAST_SETTINGS)


def search_options(command: Command) -> Command:
    """Add options for the search range and for settings; the command gets ``settings``, which has both."""

    @wraps(command)
    def with_search(
        *,
        settings: SettingsArguments,
        disparity: tuple[int, int] | None,
        local_range: bool,
        range_grid: str | None,
        **others: Any,
    ) -> Any:
        search: dict[str, Any] = dict(zip(("minimum", "maximum"), disparity or (), strict=False))
        if local_range:
            search["local"] = True
        if range_grid is not None:
            search["grid"] = range_grid
        sections = settings.sections | ({"disparity": search} if search else {})
        return command(settings=replace(settings, sections=sections), **others)

    return with_options(settings_options(with_search), *_SEARCH_OPTIONS)


def run_options(command: Command) -> Command:
    """Add options of commands that match pairs; the command gets ``run``, a `RunArguments`."""

    @wraps(command)
    def with_run(*, keep_tiles: bool, overwrite: bool, strict: bool, quiet: bool, **others: Any) -> Any:
        return command(run=RunArguments(keep_tiles, overwrite, strict, quiet), **others)

    return with_options(
        with_run,
        click.option(
            "--strict",
            is_flag=True,
            help="End with status 1 if the run prints a warning, for example that the search range is too narrow.",
        ),
        click.option("--keep-tiles", is_flag=True, help="Keep the products of tiles, until a call without it."),
        click.option(
            "--overwrite",
            is_flag=True,
            help="May replace another run in OUT; its tiles are deleted, equal ones are used again.",
        ),
        quiet_option,
        log_options,
    )
