"""Draw maps of a run: the overview, and the pixels whose interval misses the truth."""

from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from sat_intervals.results import Results
from sat_intervals.show import canvas
from sat_intervals.show.legend import PIXEL_CLASSES, SKY, VERMILION, class_counts, classify, limits, widest

_PANEL, _LARGE = 4.2, 8.0  # inches of the longer side of a map
_TEXT = 8.5  # inches, width of the text above a map
_LETTERS = 13  # in an inch of a title
_EDGE = "#888888"
_WIDE = 10  # percent of widths beyond the end of their scale: low-confidence areas are often as wide as the range


def draw_overview(results: Results, target: Path, dpi: int = canvas.DPI) -> None:
    """Draw left image, disparity, interval width, confidence and validity side by side, read from overviews."""
    rows, columns = _arrangement(results.shape)
    height, width = canvas.map_size(results.shape, _PANEL if columns > 1 else _LARGE)
    shape = canvas.fitting(results.shape, (height, width), dpi)
    bands = results.read_small(shape)
    valid = bands.valid
    disparity = np.where(valid, bands.disparity, np.nan)
    widths = np.where(valid, bands.upper - bands.lower, np.nan)
    search, end = results.config.disparity, widest(widths, _WIDE)
    maps = (
        canvas.MapLayer("Disparity", "px", disparity, "viridis", limits(disparity, (search.minimum, search.maximum))),
        canvas.MapLayer("Interval width", "px", widths, "magma", (0, end), 0.5),
        canvas.MapLayer("Confidence", "0 to 1", bands.confidence, "cividis", (0, 1)),
    )
    layers = [layer for layer in maps if np.isfinite(layer.values).any() or not valid.any()]
    frame = canvas.PlotFrame.of(results.shape)
    size = columns * (width + 1.0), rows * (height + 0.6) + 0.3
    ratio = results.region.height * results.region.width / (shape[0] * shape[1])
    thinned = [f"means of {ratio:,.{0 if ratio >= 10 else 1}f} pixels"] if shape != results.shape else []
    words = [results.report["verdict"], *(f"warning: {line}" for line in results.report["warnings"])]
    title = "\n".join([_caption(results, thinned), *(fill(line, round(_LETTERS * size[0])) for line in words)])
    with canvas.page(target, size, dpi, title, results.report["finished"]) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel in panels[len(layers) + 3 :]:
            panel.remove()
        _draw_grey(panels[0], frame, bands.image, limits(bands.image))
        for panel, layer in zip(panels[1:], layers, strict=False):
            bar = canvas.draw_layer(panel, frame, layer)
            if layer.values is widths:
                canvas.add_histogram(bar, widths, end, step=1.0)
        last, key = panels[len(layers) + 1 : len(layers) + 3]
        _draw_validity(last, key, frame, bands.validity, class_counts(results.report["counts"]))


def draw_errors(results: Results, target: Path, dpi: int = canvas.DPI) -> None:
    """Draw, in colour, the valid pixels whose interval misses the truth (the paper's figure 7), after counting all."""
    height, width = canvas.map_size(results.shape, _LARGE)
    drawn = canvas.fitting(results.shape, (height, width), dpi)
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
    low, high = limits(image)
    thinned = [f"one {name} in {step}" for name, step in (("row", down), ("column", across)) if step > 1]
    title = _caption(results, thinned) + (" shown" if thinned else "")
    with canvas.page(target, (max(_TEXT, width + 0.9), height + 1.4), dpi, title) as figure:
        panel = figure.subplots()
        # Lower contrast than in the overview, so that the colours stand out.
        frame = canvas.PlotFrame.of(results.shape)
        _draw_grey(panel, frame, image, (low - 0.3 * (high - low), high + 0.3 * (high - low)))
        share = "No valid pixel has a known truth"
        if count:
            share = f"The interval misses the truth at {100 * missed.sum() / count:.1f} % of {count:,} valid pixels"
        canvas.draw_map(panel, frame, kind, share, cmap=ListedColormap([VERMILION, SKY]), vmin=0, vmax=1)
        texts = (f"truth above the interval: {missed[0]:,} px", f"truth below it: {missed[1]:,} px")
        key = [patches.Patch(facecolor=color, label=text) for color, text in zip((VERMILION, SKY), texts, strict=True)]
        figure.legend(handles=key, loc="outside lower left", ncols=2, frameon=False)


def _arrangement(shape: tuple[int, int]) -> tuple[int, int]:
    """Return the rows and columns of six panels on a page shaped like a screen."""
    height, width = canvas.map_size(shape, 1.0)
    rows = min((1, 2, 3, 6), key=lambda rows: abs(np.log(1.5 * rows * height / (6 // rows * width))))
    return rows, 6 // rows


def _draw_grey(panel: Axes, frame: canvas.PlotFrame, image: np.ndarray, ends: tuple[float, float]) -> None:
    canvas.draw_map(panel, frame, image, "Left image", cmap="gray", vmin=ends[0], vmax=ends[1])
    canvas.say_empty(panel, image, "no data")


def _draw_validity(panel: Axes, key: Axes, frame: canvas.PlotFrame, validity: np.ndarray, counts: list[int]) -> None:
    """Draw the class of each pixel, with a legend of their shares of all pixels."""
    colours = ListedColormap([kind.colour for kind in PIXEL_CLASSES])
    canvas.draw_map(
        panel, frame, classify(validity), "Validity", cmap=colours, vmin=-0.5, vmax=len(PIXEL_CLASSES) - 0.5
    )
    entries = [
        (kind.colour, f"{kind.meaning} ({100 * count / sum(counts):.1f}\u00a0%)")
        for kind, count in zip(PIXEL_CLASSES, counts, strict=True)
        if count or kind.flag == 0
    ]
    entries.append((canvas.NOTHING, "in the other maps: no value"))
    handles = [patches.Patch(facecolor=colour, edgecolor=_EDGE, label=fill(text, 46)) for colour, text in entries]
    key.axis("off")
    key.legend(handles=handles, loc="upper left", frameon=False, title="Validity", alignment="left", borderaxespad=0)


def _caption(results: Results, thinned: list[str]) -> str:
    """Return the caption: image, size, search range, level of the intervals, and how pixels are thinned."""
    height, width = results.shape
    search, interval = results.config.disparity, results.config.interval
    parts = [f"{height} x {width} pixels", f"disparities {search.minimum} to {search.maximum} px searched"]
    if interval:
        parts.append(f"alpha {interval.alpha}" if interval.coverage is None else f"coverage {interval.coverage}")
    return f"{Path(results.left.path).name}: {', '.join(parts + thinned)}"
