"""The command ``sat-intervals``: click only; every command is one call of the library."""

from sat_intervals.cli.app import main

__all__ = ["main"]
