"""Options that many commands have, and how names of files are taken."""

from pathlib import Path

import click


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


def _debug(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    context.meta["sat_intervals.debug"] = value


quiet_option = click.option("--quiet", is_flag=True, help="Print errors only.")
debug_option = click.option(
    "--debug", is_flag=True, expose_value=False, callback=_debug, help="Show tracebacks of errors."
)
