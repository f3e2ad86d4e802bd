"""Draw what was found before the tiles: the search range, local ranges, and row offsets."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.results import Results
from sat_intervals.show.canvas import DPI, INK, MapLayer, PlotFrame, draw_layer, page
from sat_intervals.show.legend import BLUE, SKY

# Pixels of offset at the ends of the colours of row offsets, at least, and places within them: wrong ones lie beyond.
_LEAST, _SHOWN = 0.5, 0.8


def has_range(results: Results) -> bool:
    """Return whether the search range of a run was found, or is local."""
    return bool(results.report.get("search") or results.report.get("local_ranges"))


def draw_range(results: Results, target: Path, dpi: int = DPI) -> None:
    """Draw the matches of the search by disparity, and first and last disparity of the cells."""
    report, search = results.report, results.config.disparity
    found = report.get("search")
    local = report.get("local_ranges") or (found and found["cells"])
    ends, valid = report["counts"]["range_ends"], max(1, report["counts"]["valid"])
    title = (
        f"{Path(results.left.path).name}: disparities {search.minimum} to {search.maximum} px searched, "
        f"{100 * ends['minimum'] / valid:.2g} % of the valid ones at the minimum, "
        f"{100 * ends['maximum'] / valid:.2g} % at the maximum"
    )
    panels = (1 if found else 0) + (2 if local else 0)
    with page(target, (4.6 * panels, 4.2), dpi, title) as figure:
        charts = iter(figure.subplots(1, panels, squeeze=False)[0])
        if found:
            _draw_matches(next(charts), found, (search.minimum, search.maximum))
        if local:
            ranges = LocalRanges.of_report(local)
            rows, columns = ranges.minimum.shape
            frame = PlotFrame.of((ranges.height * rows, ranges.width * columns))
            used = "" if report.get("local_ranges") else ", not used"
            share = f": {100 * ranges.share:.0f} % searched"
            for title, ends in (("minimum" + used, ranges.minimum), ("maximum" + used + share, ranges.maximum)):
                layer = MapLayer(f"Local {title}", "px", ends, "viridis", (search.minimum, search.maximum))
                draw_layer(next(charts), frame, layer)


def _draw_matches(chart: Axes, found: dict[str, Any], searched: tuple[int, int]) -> None:
    """Draw the histogram of the consistent matches, and the range."""
    edges, counts = np.array(found["histogram"]["edges"]), np.array(found["histogram"]["counts"])
    chart.stairs(np.maximum(counts, 0.5), edges, baseline=0.5, fill=True, color=BLUE)
    chart.axvspan(*searched, color=SKY, alpha=0.25, lw=0)
    chart.set(yscale="log", ylabel="matches")
    chart.set_title(f"Matches on {100 * found['matched']:.0f} % of the pixels")
    levels = ", ".join(f"{level['step']} px: {level['minimum']} to {level['maximum']}" for level in found["levels"])
    chart.text(
        0.02, 0.98, f"searched at {levels}", transform=chart.transAxes, va="top", fontsize=8, color=INK, wrap=True
    )


def has_rows(results: Results) -> bool:
    """Return whether the rows of a run were compared."""
    return bool((results.report.get("survey") or {}).get("rows"))


def draw_rows(results: Results, target: Path, dpi: int = DPI) -> None:
    """Draw the row offsets at the places that were looked at, and what the function leaves of them, in pixels."""
    found = results.report["survey"]["rows"]
    row, column, before, after = np.array(found["samples"]).T
    done = "taken out of the right image" if results.rows else "left as they are"
    title = (
        f"{Path(results.right.path).name}: rows differ by {found['before'][0]:.2f} px in the median, "
        f"{found['after'][0]:.2f} px from a smooth function; {done}"
    )
    with page(target, (9.2, 4.2), dpi, title) as figure:
        panels = figure.subplots(1, 2)
        for panel, values, name in zip(panels, (before, after), ("Row offset, px", "What is left, px"), strict=True):
            most = max(_LEAST, float(np.quantile(np.abs(values), _SHOWN)))
            dots = panel.scatter(column, row, c=values, s=150, cmap="RdBu", vmin=-most, vmax=most, edgecolors="0.4")
            panel.set(title=name, xlim=(0, results.right.width), ylim=(results.right.height, 0), aspect="equal")
            panel.set(xlabel="column", ylabel="row")
            figure.colorbar(dots, ax=panel, extend="both" if np.abs(values).max() > most else "neither")
