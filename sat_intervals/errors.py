"""The one family of errors this package raises for what a user can put right."""


class SatIntervalsError(ValueError):
    """Base of every error of the package: one line that names what clashes and the way out."""


class RunError(SatIntervalsError):
    """A run that failed on its way, by no fault of its arguments; what is done is kept for the next try."""
