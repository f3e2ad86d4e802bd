"""Pictures of a finished run for people, as PNG files. The only home of matplotlib (the extra ``plot``)."""

from importlib.util import find_spec

from sat_intervals.errors import SatIntervalsError

if find_spec("matplotlib") is None:
    raise SatIntervalsError("pictures need matplotlib: pip install 'sat-intervals[plot]'")

from sat_intervals.show.dsm import draw_surface
from sat_intervals.show.maps import draw_errors, draw_overview
from sat_intervals.show.profile import draw_curve, draw_profile

__all__ = ["draw_curve", "draw_errors", "draw_overview", "draw_profile", "draw_surface"]
