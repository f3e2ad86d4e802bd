"""Draw maps of a run: the overview, and the pixels whose interval misses the truth."""

from pathlib import Path
from textwrap import fill
from typing import Any, Literal

import numpy as np
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import ListedColormap, PowerNorm
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator

from sat_intervals.errors import SatIntervalsError
from sat_intervals.results import Results
from sat_intervals.show.canvas import (
    DPI,
    INK,
    NOTHING,
    add_histogram,
    fitting,
    limits,
    page,
    pointed_ends,
    say_empty,
    widest,
)
from sat_intervals.show.legend import PIXEL_CLASSES, SKY, VERMILION, class_counts, classify

_PANEL, _LARGE = 4.2, 8.0  # inches of the longer side of a map
_TEXT = 8.5  # inches, width of the text above a map
_STRETCHED = 5.0  # largest ratio of the sides of a map; pixels of longer ones are not square
_EDGE = "#888888"


def draw_overview(results: Results, target: Path, dpi: int = DPI) -> None:
    """Draw left image, disparity, interval width, confidence and validity side by side, read from overviews."""
    rows, columns = _arrangement(results.shape)
    width, height = _inches(results.shape, _PANEL if columns > 1 else _LARGE)
    shape = fitting(results.shape, (height, width), dpi)
    bands = results.read_small(shape)
    valid = bands.valid
    disparity = np.where(valid, bands.disparity, np.nan)
    widths = np.where(valid, bands.upper - bands.lower, np.nan)
    search = results.config.disparity
    thinned = shape if shape != results.shape else None
    size = columns * (width + 1.0), rows * (height + 0.6) + 0.3
    with page(target, size, dpi, _caption(results, thinned), results.report["finished"]) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        _draw_grey(panels[0], results, bands.image, limits(bands.image, (0, 1)))
        fitted = limits(disparity, (search.minimum, search.maximum))
        _draw_map(panels[1], results, disparity, ("Disparity", "px"), "viridis", fitted)
        end = widest(widths)
        bar = _draw_map(panels[2], results, widths, ("Interval width", "px"), "magma", (0, end), 0.5)
        add_histogram(bar, widths, end, step=1.0)
        _draw_map(panels[3], results, bands.confidence, ("Confidence", "0 to 1"), "cividis", (0, 1))
        _draw_validity(panels[4], panels[5], results, bands.validity)


def draw_errors(results: Results, target: Path, dpi: int = DPI) -> None:
    """Draw the left image and, in colour, the valid pixels whose interval misses the truth (the paper's figure 7).

    All pixels are counted; of large results, every n-th row and column is drawn.
    """
    if results.truth is None:
        raise SatIntervalsError(f"{results.out}: errors need a truth: give --truth")
    if results.config.interval is None:
        raise SatIntervalsError(f"{results.out} has no intervals, its setting interval is null: errors need them")
    width, height = _inches(results.shape, _LARGE)
    drawn = fitting(results.shape, (height, width), dpi)
    down, across = (-(-size // dots) for size, dots in zip(results.shape, drawn, strict=True))
    count, missed = 0, np.zeros(2, np.int64)
    images, kinds = [], []
    for row, bands in results.strips():
        valid = bands.valid
        above, below = valid & (bands.truth > bands.upper), valid & (bands.truth < bands.lower)
        count += int((valid & bands.known).sum())
        missed += above.sum(), below.sum()
        chosen = np.s_[-row % down :: down, ::across]
        images.append(bands.image[chosen].copy())  # a view would keep the whole strip in memory
        kinds.append(np.where(above, 0.0, np.where(below, 1.0, np.nan))[chosen].copy())
    image, kind = np.concatenate(images), np.concatenate(kinds)
    low, high = limits(image, (0, 1))
    thinned = [f"one {name} in {step}" for name, step in (("row", down), ("column", across)) if step > 1]
    title = ", ".join([_caption(results, None), *thinned]) + (" shown" if thinned else "")
    with page(target, (max(_TEXT, width + 0.9), height + 1.4), dpi, title) as figure:
        panel = figure.subplots()
        # Lower contrast than in the overview, so that the colours stand out.
        _draw_grey(panel, results, image, (low - 0.3 * (high - low), high + 0.3 * (high - low)))
        _show(panel, results, kind, cmap=ListedColormap([VERMILION, SKY]), vmin=0, vmax=1)
        panel.set_title(_share_text(int(missed.sum()), count))
        texts = (f"truth above the interval: {missed[0]:,} px", f"truth below it: {missed[1]:,} px")
        key = [patches.Patch(facecolor=color, label=text) for color, text in zip((VERMILION, SKY), texts, strict=True)]
        figure.legend(handles=key, loc="outside lower left", ncols=2, frameon=False)


def _share_text(missed: int, count: int) -> str:
    if count == 0:
        return "No valid pixel has a known truth"
    return f"The interval misses the truth at {100 * missed / count:.1f} % of {count:,} valid pixels"


def _arrangement(shape: tuple[int, int]) -> tuple[int, int]:
    """Return the rows and columns of six panels on a page shaped like a screen."""
    width, height = _inches(shape, 1.0)
    rows = min((1, 2, 3, 6), key=lambda rows: abs(np.log(1.5 * rows * height / (6 // rows * width))))
    return rows, 6 // rows


def _inches(shape: tuple[int, int], longest: float) -> tuple[float, float]:
    """Return width and height of a map, the longer one ``longest``."""
    tall = float(np.clip(shape[0] / shape[1], 1 / _STRETCHED, _STRETCHED))
    width = min(longest, longest / tall)
    return width, width * tall


def _show(panel: Axes, results: Results, pixels: np.ndarray, **options: Any) -> AxesImage:
    """Draw a layer with axes in rows and columns of the results."""
    height, width = results.shape
    panel.set_facecolor(NOTHING)
    panel.xaxis.set_major_locator(MaxNLocator(4, integer=True, min_n_ticks=1))
    panel.yaxis.set_major_locator(MaxNLocator(4, integer=True, min_n_ticks=1))
    panel.tick_params(labelsize=8, colors=INK)
    panel.set_xlabel("column", fontsize=8, color=INK)
    panel.set_ylabel("row", fontsize=8, color=INK)
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    aspect: Literal["equal", "auto"] = "equal" if max(height / width, width / height) <= _STRETCHED else "auto"
    return panel.imshow(pixels, extent=extent, aspect=aspect, interpolation="nearest", **options)


def _draw_grey(panel: Axes, results: Results, image: np.ndarray, shown: tuple[float, float]) -> None:
    _show(panel, results, image, cmap="gray", vmin=shown[0], vmax=shown[1])
    panel.set_title("Left image")
    say_empty(panel, image, "no data")


def _draw_map(
    panel: Axes,
    results: Results,
    values: np.ndarray,
    name: tuple[str, str],
    colours: str,
    shown: tuple[float, float],
    power: float = 1.0,
) -> Colorbar:
    """Draw a layer titled ``name[0]`` with unit ``name[1]``; a ``power`` of 1/2 brightens small values."""
    drawn = _show(panel, results, values, cmap=colours, norm=PowerNorm(power, *shown))
    panel.set_title(name[0])
    assert panel.figure is not None
    bar = panel.figure.colorbar(drawn, ax=panel, extend=pointed_ends(values, *shown), shrink=0.9, aspect=25, pad=0.02)
    bar.set_label(name[1] if power == 1 else f"{name[1]}, square-root scale")
    bar.ax.tick_params(labelsize=8)
    say_empty(panel, values, "no value")
    return bar


def _draw_validity(panel: Axes, key: Axes, results: Results, validity: np.ndarray) -> None:
    """Draw the class of each pixel, with a legend of their shares of all pixels."""
    places = classify(validity)
    colours = ListedColormap([kind.colour for kind in PIXEL_CLASSES])
    _show(panel, results, places, cmap=colours, vmin=-0.5, vmax=len(PIXEL_CLASSES) - 0.5)
    panel.set_title("Validity")
    counts = class_counts(results.report["counts"])
    entries = [
        (kind.colour, f"{kind.meaning} ({100 * count / sum(counts):.1f}\u00a0%)")
        for kind, count in zip(PIXEL_CLASSES, counts, strict=True)
        if count or kind.flag == 0
    ]
    entries.append((NOTHING, "in the other maps: no value"))
    handles = [patches.Patch(facecolor=colour, edgecolor=_EDGE, label=fill(text, 46)) for colour, text in entries]
    key.axis("off")
    key.legend(handles=handles, loc="upper left", frameon=False, title="Validity", alignment="left", borderaxespad=0)


def _caption(results: Results, thinned: tuple[int, int] | None) -> str:
    """Return the caption: image, size, search range, and the share of pixels drawn."""
    height, width = results.shape
    search, interval = results.config.disparity, results.config.interval
    parts = [f"{height} x {width} pixels", f"disparities {search.minimum} to {search.maximum} px searched"]
    if interval:
        parts.append(f"alpha {interval.alpha}" if interval.coverage is None else f"coverage {interval.coverage}")
    if thinned:
        ratio = height * width / (thinned[0] * thinned[1])
        parts.append(f"one pixel in {ratio:,.{0 if ratio >= 10 else 1}f} shown")
    return f"{Path(results.left.path).name}: {', '.join(parts)}"
