"""Options shared by the commands that match: settings, the run."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli import options
from sat_intervals.cli.options import FILE, NAME, Command, Printing, expert_option, gathered

if TYPE_CHECKING:
    from sat_intervals.config import Config
    from sat_intervals.raster import Image


@dataclass(frozen=True)
class SettingsArguments:
    """A file of settings, and the sections of the command line, which win over it; names of the options given."""

    file: Path | None
    sections: dict[str, Any]
    options: tuple[str, ...] = ()

    def load(self, images: int = 2, **sections: Any) -> "Config":
        """Load the settings for a number of images; the sections given here win."""
        from sat_intervals.config import load_config

        return load_config(load_config(self.file, self.sections, images=images), sections)

    def check_kept(self, out: Path, *others: Path) -> None:
        """Raise if a run in the folder ``out``, or another file that is written, would replace the file of settings."""
        from sat_intervals.raster.identity import check_not_replaced
        from sat_intervals.run.state import OUTPUTS

        check_not_replaced([self.file], [*(out / name for name in OUTPUTS), *others], [out / "tiles"])


@dataclass(frozen=True)
class RunArguments(Printing):  # type: ignore[misc,unused-ignore]
    """How a run treats the tiles and files of its folder, and what it prints."""

    keep_tiles: bool
    overwrite: bool
    strict: bool
    dry_run: bool

    def says_job(self, config: "Config", out: Path) -> bool:
        """Print the job script of the cluster if nothing else is to be done."""
        if self.dry_run:
            from sat_intervals.run.batch_system import job_script
            from sat_intervals.run.state import with_store

            click.echo(job_script(with_store(config.cluster, out), out))
        return self.dry_run

    def match(
        self, left: "Image | Path", right: "Image | Path", out: Path, config: "Config", **more: Any
    ) -> dict[str, Any]:
        """Match a pair to the folder ``out``; ``more`` are arguments of `match_pair`."""
        from sat_intervals.run.pair import match_pair

        return match_pair(left, right, out, config, keep_tiles=self.keep_tiles, overwrite=self.overwrite, **more)

    def check_strict(self, warnings: Sequence[str]) -> None:
        """Raise if the run has warned, in lines that were printed, and must not."""
        if self.strict and warnings:
            from sat_intervals.errors import RunError

            count = "1 warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
            raise RunError(f"{count}, see above, and --strict is given; the files are written")


_SEARCH_OPTIONS = (
    click.option(
        "--disparity",
        type=int,
        nargs=2,
        metavar="MIN MAX",
        help="Search range in pixels, both ends searched; default: found from the images.",
    ),
    expert_option(
        "--local-range",
        is_flag=True,
        default=None,
        help="Search a separate range in each cell of the image, found from the images.",
    ),
    expert_option(
        "--around", type=NAME, help="Disparities of another matcher, a raster: search around them and audit them."
    ),
    expert_option("--margin", type=int, metavar="K", help="Pixels to search on both sides of --around; default 8."),
)
_CONFIG_OPTION = click.option("--config", "config_file", type=FILE, help="Settings (YAML); the command line wins.")
_PRESET_OPTION = click.option(
    "--preset",
    type=click.Choice(options.PRESETS),
    help="satellite (default), satellite-mccnn for different dates or little texture, paper and mccnn for close "
    "range, many for three images or more (surface takes it by itself).",
)
_LEVEL_OPTIONS = (
    click.option(
        "--coverage",
        type=float,
        metavar="C",
        help="Share of true values that intervals contain, .5 to .99; default .9.",
    ),
    click.option("--calibration", type=NAME, help="Calibration for --coverage; default the built-in one."),
    expert_option("--alpha", type=float, metavar="A", help="Level of possibility, above 0 to 1; no coverage."),
)
_WORKER_OPTIONS = (
    click.option("--workers", type=click.IntRange(min=1), help="Tiles at once; default one per core."),
    expert_option(
        "--cluster",
        metavar="SPEC",
        help="threads (default), processes, slurm, pbs, lsf, sge, or the address of a dask scheduler.",
    ),
)
_OTHER_OPTIONS = (
    expert_option(
        "--rows", type=click.Choice(("auto", "none")), help="Row offsets of the right image: taken out, or left."
    ),
    expert_option("--tile-size", type=int, help="Side of a tile's core in pixels, a multiple of 64."),
    *_WORKER_OPTIONS,
    expert_option(
        "--set", "named", multiple=True, metavar="KEY=VALUE", help="Any other setting, such as tiles.overlap=100."
    ),
)

# Dotted names of the options that are settings as they stand.
_PLACES = {
    "rows": "rows",
    "coverage": "interval.coverage",
    "calibration": "interval.calibration",
    "alpha": "interval.alpha",
    "tile_size": "tiles.size",
    "workers": "cluster.workers",
    "local_range": "disparity.local",
    "around": "disparity.around",
    "margin": "disparity.margin",
}


def _settings(
    *,
    config_file: Path | None,
    cluster: str | None,
    preset: str | None = None,
    named: tuple[str, ...] = (),
    disparity: tuple[int, int] | None = None,
    **values: Any,
) -> SettingsArguments:
    """Return the settings that options give; ``values`` are those of _PLACES."""
    values = {name: values.get(name) for name in _PLACES}
    if values["margin"] is not None and values["around"] is None and config_file is None:
        raise click.UsageError("--margin is for --around: give both.")
    given = {"config": config_file, "preset": preset, "cluster": cluster, "set": named or None} | values
    sections = _named(named)
    _put(sections, "--preset", preset=preset)
    for name, key in _PLACES.items():
        _put(sections, f"--{name.replace('_', '-')}", **{key: values[name]})
    address = cluster if cluster and "://" in cluster else None
    kind = "address" if address else cluster or None
    _put(sections, "--cluster", **{"cluster.kind": kind, "cluster.address": address})
    minimum, maximum = disparity or (None, None)
    _put(sections, "--disparity", **{"disparity.minimum": minimum, "disparity.maximum": maximum})
    chosen = tuple(f"--{name.replace('_', '-')}" for name, value in given.items() if value is not None)
    return SettingsArguments(config_file, sections, chosen)


def _put(sections: dict[str, Any], option: str, **settings: Any) -> None:
    """Put what an option sets, by dotted names, into sections of settings; None is not given."""
    from sat_intervals.config.files import set_by_name

    for key, value in settings.items():
        if value is not None:
            try:
                set_by_name(sections, key, value)
            except ValueError as error:
                raise click.UsageError(f"{option} and --set {key}: {error}") from error


def _named(settings: tuple[str, ...]) -> dict[str, Any]:
    """Return the sections of settings given as ``KEY=VALUE``, whose values are YAML."""
    if not settings:
        return {}
    import yaml

    from sat_intervals.config.files import load_yaml, set_by_name

    sections: dict[str, Any] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        try:
            if not equals:
                raise ValueError("give KEY=VALUE, such as tiles.overlap=100")
            set_by_name(sections, key, load_yaml(value))
        except (ValueError, yaml.YAMLError) as error:
            raise click.UsageError(f"--set {setting}: {' '.join(str(error).split())}") from error
    return sections


# The command gets ``settings``: of workers alone, of all but levels, of all, or of all with the search range.
cluster_options = gathered("settings", _settings, _CONFIG_OPTION, *_WORKER_OPTIONS)
options_without_levels = gathered("settings", _settings, _CONFIG_OPTION, _PRESET_OPTION, *_OTHER_OPTIONS)
_ALL = _CONFIG_OPTION, _PRESET_OPTION, *_LEVEL_OPTIONS, *_OTHER_OPTIONS
settings_options = gathered("settings", _settings, *_ALL)
search_options = gathered("settings", _settings, *_SEARCH_OPTIONS, *_ALL)


def run_options(command: Command) -> Command:
    """Add options of commands that match pairs; the command gets ``run``, a `RunArguments`."""
    with_run = gathered(
        "run",
        RunArguments,
        expert_option("--dry-run", is_flag=True, help="Print the job script of the cluster; submit nothing."),
        expert_option("--strict", is_flag=True, help="End with status 1 if the run prints a warning."),
        expert_option("--keep-tiles", is_flag=True, help="Keep the products of tiles, until a call without it."),
        click.option(
            "--overwrite",
            is_flag=True,
            help="May replace another run in OUT; its tiles are deleted, equal ones are used again.",
        ),
        options.json_option,
        options.quiet_option,
    )
    return with_run(options.log_options(command))
