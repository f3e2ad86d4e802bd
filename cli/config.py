"""``sat-intervals config``: print a complete, commented file of settings."""

import click

from sat_intervals.cli.options import PRESETS


@click.command(short_help="Print a complete, commented file of settings.")
@click.option("--preset", type=click.Choice(PRESETS), default=PRESETS[0], show_default=True, help="Which settings.")
def config(preset: str) -> None:
    """Print a complete, commented YAML file of settings, to edit and use with `match --config`."""
    from sat_intervals.config import preset_text

    click.echo(preset_text(preset), nl=False)
