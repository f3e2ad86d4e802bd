"""The command ``sat-intervals``, written with click; every command is one call of the library."""

from sat_intervals.cli.app import main

__all__ = ["main"]
