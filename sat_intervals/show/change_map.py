"""Draw the change of height between two dates: where it is significant, in diverging colours."""

from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.products import CHANGE
from sat_intervals.raster import read_place, read_small_layers
from sat_intervals.show import canvas

_LONGEST = 8.0  # inches of the longer side of the map
# Percentile of absolute changes at the ends of the colours, which are at most so many times their median.
_CUT, _TIMES = 98, 3
_UNCHANGED = 0.8  # grey level


def draw_change(change: Path, report: dict[str, Any], target: Path, dpi: int = canvas.DPI) -> None:
    """Draw the map of a change, from the overviews; ``report`` is the content of ``change.json``."""
    shape, place = read_place(change)
    inches = canvas.map_size(shape, _LONGEST)
    drawn = canvas.fitting(shape, inches, dpi)
    bands = dict(zip((band.name for band in CHANGE), read_small_layers(change, drawn), strict=True))
    changed = np.abs(bands["change"]) == 1
    height = np.where(changed, bands["difference"], np.nan)
    sizes = np.abs(height[changed]) if changed.any() else np.ones(1)
    end = float(min(np.percentile(sizes, _CUT), _TIMES * np.median(sizes)))  # small changes keep their colours
    left, top, (across, down) = place.affine.c, place.affine.f, place.pixel_size
    frame = canvas.PlotFrame(left, left + shape[1] * across, top - shape[0] * down, top, canvas.GROUND)
    (gained, of_gained), (lost, of_lost) = (report["volume"][name] for name in ("gained", "lost"))
    caption = (
        f"{report['before']} to {report['after']}\nfalse alarms {100 * report['rate']['named']:g} %, areas of "
        f"{report['smallest_area']:g} m2 or more; gained {gained:.0f} +-{of_gained:.0f}, lost {lost:.0f} "
        f"+-{of_lost:.0f} m3 (standard deviations)"
    )
    layer = canvas.MapLayer(
        "Significant change of height; grey: none, white: unknown", "m", height, "RdBu", (-end, end)
    )
    with canvas.page(target, (inches[1] + 1.9, inches[0] + 1.1), dpi, caption) as figure:
        panel = figure.subplots()
        known = np.where(np.isfinite(bands["change"]), _UNCHANGED, 1.0)
        canvas.draw_layer(panel, frame, layer._replace(if_empty="no significant change"))
        panel.imshow(known, extent=frame[:4], cmap="gray", vmin=0, vmax=1, interpolation="nearest", zorder=-1)
        canvas.add_scale_bar(panel, frame)
