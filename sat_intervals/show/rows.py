"""Draw what was found before the tiles: the search range, and how far the rows of the two images differ."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from sat_intervals.results import Results
from sat_intervals.show.canvas import DPI, page
from sat_intervals.show.search_range import draw_range, has_range

# Pixels of offset at the ends of the colours of what is left, at least.
_LEAST = 0.5


def before_tiles(results: Results, dpi: int = DPI) -> dict[str, Callable[[Path], None]]:
    """Return what draws ``range`` and ``rows`` to a path, if they were found."""
    has_rows = bool((results.report.get("survey") or {}).get("rows"))
    found = (("range", has_range(results), draw_range), ("rows", has_rows, draw_rows))
    return {name: partial(draw, results, dpi=dpi) for name, is_found, draw in found if is_found}


def draw_rows(results: Results, target: Path, dpi: int = DPI) -> None:
    """Draw the row offsets at the places that were looked at, and what the function leaves of them, in pixels."""
    found = results.report["survey"]["rows"]
    row, column, before, after = np.array(found["looks"]).T
    done = "taken out of the right image" if results.rows else "left as they are"
    title = (
        f"{Path(results.right.path).name}: rows differ by {found['before'][0]:.2f} px in the median, "
        f"{found['after'][0]:.2f} px from a smooth function; {done}"
    )
    with page(target, (9.2, 4.2), dpi, title) as figure:
        panels = figure.subplots(1, 2)
        for panel, values, name in zip(panels, (before, after), ("Row offset, px", "What is left, px"), strict=True):
            most = max(_LEAST, float(np.abs(values).max()))
            dots = panel.scatter(column, row, c=values, s=150, cmap="RdBu", vmin=-most, vmax=most, edgecolors="0.4")
            panel.set(title=name, xlim=(0, results.right.width), ylim=(results.right.height, 0), aspect="equal")
            panel.set(xlabel="column", ylabel="row")
            figure.colorbar(dots, ax=panel)
