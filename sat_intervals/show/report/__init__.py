"""Write ``report.html``, a self-contained page of a finished run for any browser."""

from sat_intervals.show.report.page import write_report

__all__ = ["write_report"]
