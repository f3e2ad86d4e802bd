"""One page that shows a finished run to people: ``report.html``, for any browser, without a network."""

from sat_intervals.show.report.page import write_report

__all__ = ["write_report"]
