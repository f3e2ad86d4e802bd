"""Draw line charts: the interval along a row, and the cost curve of a pixel."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from sat_intervals.products import INVALID
from sat_intervals.results import Results
from sat_intervals.show.canvas import DPI, INK, NOTHING, fitting, page, say_empty
from sat_intervals.show.cost_curve import Curve, read_curve
from sat_intervals.show.legend import BLUE, ORANGE, SKY, VERMILION, limits
from sat_intervals.tiling import Window

_WIDTH, _STRIP = 12.0, 1.0  # inches: of the page, and height of the image above a profile
_KEYS = 4  # entries in a row of a legend
_LOW, _BARS = "#d4d4d4", 9


def draw_profile(
    results: Results, target: Path, row: int, columns: tuple[int, int] | None = None, dpi: int = DPI
) -> None:
    """Draw interval, disparity and truth along a row, low confidence in grey (the paper's figures 5, 7, 8)."""
    first, last = results.check_part(row, columns)
    bands = results.read(Window(row, 0, 1, results.region.width))
    valid = bands.valid
    lines = [np.where(valid, band, np.nan) for band in (bands.lower, bands.upper, bands.disparity)]
    # Draw each pixel as a step, visible even between invalid neighbours.
    lines += [bands.truth, _areas(results.low(bands))]
    lower, upper, disparity, truth, low = (np.repeat(line[0, first : last + 1], 2) for line in lines)
    edges = np.repeat(np.arange(first, last + 2) - 0.5, 2)[1:-1]
    has_intervals = results.config.interval is not None
    title = f"Row {row}, columns {first} to {last}; gaps: invalid pixels"
    with page(target, (_WIDTH, 5.4), dpi, title) as figure:
        strip, chart = figure.subplots(2, 1, sharex=True, height_ratios=(1, 4))
        _draw_strip(strip, results, row, first, last, dpi)
        if low.any():
            over = chart.get_xaxis_transform()
            chart.fill_between(edges, 0, 1, where=low, transform=over, color=_LOW, lw=0, label="low confidence")
        if has_intervals:
            chart.fill_between(edges, lower, upper, color=SKY, alpha=0.7, lw=0.8, label="interval")
        if np.isfinite(truth).any():
            chart.plot(edges, truth, color=VERMILION, lw=1.2, label="truth")
        chart.plot(edges, disparity, color="black", lw=0.9, label="disparity")
        _finish_chart(chart, "column", "disparity (px)", (first - 0.5, last + 0.5))
        chart.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        if not np.isfinite(disparity).any():
            search = results.config.disparity
            chart.set_ylim(search.minimum - 0.5, search.maximum + 0.5)
        say_empty(chart, disparity, "no valid pixel")


def _areas(low: np.ndarray) -> np.ndarray:
    """Return where most of 9 columns have low confidence: single pixels would make a barcode."""
    padded = np.pad(low[0].astype(int), _BARS // 2, mode="edge")
    return np.asarray(np.convolve(padded, np.ones(_BARS, int), mode="valid") > _BARS // 2)[np.newaxis]


def draw_curve(results: Results, target: Path, row: int, column: int, dpi: int = DPI) -> None:
    """Match a pixel again; draw its costs, possibilities, cut (the paper's figures 2, 3), and the written interval."""
    curve = read_curve(results, row, column)
    pixel = results.read_pixel(row, column)
    title = f"Row {row}, column {column}, {'rejected' if pixel.validity & INVALID else 'valid'}"
    if np.isfinite(pixel.confidence):
        title += f", confidence {pixel.confidence:.2f}"
    search = results.config.disparity
    margin = max(1.0, 0.02 * search.count)
    across = (search.minimum - margin, search.maximum + margin)
    with page(target, (9.0, 7.5), dpi, title) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 3))
        above.plot(curve.disparities, curve.costs, color="black", lw=1, marker="o", ms=3, label="cost curve")
        below.plot(curve.disparities, curve.possibilities, color="black", lw=1, marker="o", ms=3, label="possibility")
        if curve.cut.any():
            _draw_cut(below, curve, results)
        if np.isfinite(pixel.lower):
            text = f"interval written, {pixel.lower:.4g} to {pixel.upper:.4g} px"
            # The marker shows an interval of zero width.
            bar = {"color": ORANGE, "lw": 6, "solid_capstyle": "butt", "marker": "|", "ms": 9, "mew": 3, "label": text}
            below.plot([pixel.lower, pixel.upper], [-0.08, -0.08], **bar)
        lines = [("V-fit" if results.config.fits else "disparity", curve.disparity, "black", ":")]
        lines += [("truth", float(pixel.truth), VERMILION, "-")] if np.isfinite(pixel.truth) else []
        for name, place, colour, style in lines:
            shown = across[0] <= place <= across[1]
            label = f"{name} {place:.2f} px" + ("" if shown else ", outside the range shown")
            above.axvline(place, color=colour, lw=1, ls=style, label=label)
            below.axvline(place, color=colour, lw=1, ls=style)
        below.set_ylim(-0.14, 1.06)
        unit = "aggregated by SGM" if results.config.sgm else "not aggregated"
        _finish_chart(above, "", f"cost, {unit}", across)
        _finish_chart(below, "disparity (px)", "possibility", across)


def _draw_cut(chart: Axes, curve: Curve, results: Results) -> None:
    """Draw the alpha-cut of the possibilities and the interval derived from it."""
    interval = results.config.interval
    name = f"level {curve.level:.3f}" if interval is None or interval.alpha is None else f"alpha = {curve.level:g}"
    chart.axhline(curve.level, color=INK, lw=0.8, ls="--")
    chart.text(1, curve.level, name, transform=chart.get_yaxis_transform(), ha="right", va="bottom", color=INK)
    inside = curve.disparities[curve.cut]
    chart.plot(inside, curve.possibilities[curve.cut], "o", color=BLUE, ms=6, label="cut")
    wider = not results.config.has_coverage and (curve.lower < inside.min() or curve.upper > inside.max())
    ends = f"{curve.lower:.4g} to {curve.upper:.4g} px"
    of_cut = f"cut, {ends}" if results.config.fits else f"interval of the cut, {ends}"
    text = f"interval, {ends}:\ncut pushed out by refinement" if wider else of_cut
    chart.vlines([curve.lower, curve.upper], 0, 1, color=BLUE, lw=1.2, label=text)
    arrow = {"arrowstyle": "<->", "color": BLUE, "shrinkA": 0, "shrinkB": 0}
    chart.annotate("", (curve.lower, 0.05), (curve.upper, 0.05), arrowprops=arrow)


def _finish_chart(chart: Axes, across: str, up: str, shown: tuple[float, float]) -> None:
    """Set axis labels, limits, grid and legend."""
    chart.set(xlabel=across, ylabel=up, xlim=shown)
    chart.grid(axis="y", color="#e8e8e8", zorder=0)
    chart.spines[["top", "right"]].set_visible(False)
    keys = _KEYS if len(chart.get_legend_handles_labels()[0]) < _KEYS else _KEYS // 2  # else too wide for the page
    chart.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=keys, frameon=False, borderaxespad=0.2)


def _draw_strip(panel: Axes, results: Results, row: int, first: int, last: int, dpi: int) -> None:
    """Draw the left image around a part of a row; a dashed line marks the row."""
    columns = last - first + 1
    reach = max(1, round(columns / 26))
    top, bottom = max(0, row - reach), min(results.region.height, row + reach + 1)
    window = Window(top, first, bottom - top, columns)
    image = results.read_small_left(window, fitting((window.height, window.width), (_STRIP, _WIDTH), dpi))
    low, high = limits(image)
    extent = (first - 0.5, last + 0.5, bottom - 0.5, top - 0.5)
    panel.imshow(image, cmap="gray", vmin=low, vmax=high, extent=extent, aspect="auto", interpolation="nearest")
    panel.axhline(row, color=ORANGE, lw=1.2, ls="--")
    panel.set_facecolor(NOTHING)
    panel.set_ylabel("row")
    panel.set_yticks([row])
