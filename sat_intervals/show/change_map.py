"""Draw the change of height between two dates: where it is significant, in diverging colours."""

from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.raster import read_place, read_small_layers
from sat_intervals.show import canvas
from sat_intervals.show.legend import widest

_LONGEST = 8.0  # inches of the longer side of the map
# Percent of absolute changes beyond the ends of the colours, which are at most so many times their median.
_CUT, _TIMES = 2, 3
_UNCHANGED = 0.8  # grey level


def draw_change(change: Path, report: dict[str, Any], target: Path, dpi: int = canvas.DPI) -> None:
    """Draw the map of a change, from the overviews; ``report`` is the content of ``change.json``."""
    shape, place = read_place(change)
    inches = canvas.map_size(shape, _LONGEST)
    difference, *_, kind = read_small_layers(change, canvas.fitting(shape, inches, dpi))
    frame, changed = canvas.PlotFrame.on_map(place, shape), np.where(np.abs(kind) == 1, difference, np.nan)
    end = widest(np.abs(changed), _CUT, _TIMES)  # small changes keep their colours
    (gained, of_gained), (lost, of_lost) = (report["volume"][name] for name in ("gained", "lost"))
    caption = (
        f"{report['before']} to {report['after']}\nfalse alarms {100 * report['rate']['named']:g} %, areas of "
        f"{report['smallest_area']:g} m2 or more; gained {gained:.0f} +-{of_gained:.0f}, lost {lost:.0f} "
        f"+-{of_lost:.0f} m3 (standard deviations)"
    )
    title, empty = "Significant change of height; grey: none, white: unknown", "no significant change"
    layer = canvas.MapLayer(title, "m", changed, "RdBu", (-end, end), if_empty=empty)
    with canvas.page(target, (inches[1] + 1.9, inches[0] + 1.1), dpi, caption) as figure:
        panel = figure.subplots()
        canvas.draw_layer(panel, frame, layer)
        known = np.where(np.isfinite(kind), _UNCHANGED, 1.0)
        panel.imshow(known, extent=frame[:4], cmap="gray", vmin=0, vmax=1, interpolation="nearest", zorder=-1)
        canvas.add_scale_bar(panel, frame)
