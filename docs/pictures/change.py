"""Draw what two rules find between two surfaces: on ground without a change, and with blocks put into the second.

usage: python docs/pictures/change.py BEFORE AFTER FOLDER TARGET
"""

import sys
from pathlib import Path

import numpy as np
import rasterio
from matplotlib.figure import Figure

import sat_intervals
from sat_intervals.kernels.components import component_sizes

# Row, column and half side in cells, and height in metres, of the blocks.
BLOCKS = (70, 320, 15, 3), (300, 300, 20, 4), (400, 400, 20, 3), (150, 80, 15, 5), (420, 230, 12, 8), (210, 420, 15, -4)
LIMIT, SMALLEST = 3.0, 50.0  # metres, m2


def with_blocks(surface: Path, target: Path) -> Path:
    """Write a copy of a surface with blocks."""
    with rasterio.open(surface) as dataset:
        bands, kind, tags, names = dataset.read(), dataset.profile, dataset.tags(), dataset.descriptions
    for row, column, half, rise in BLOCKS:
        bands[:3, row - half : row + half, column - half : column + half] += rise
    with rasterio.open(target, "w", **kind) as dataset:
        dataset.write(bands)
        dataset.update_tags(**tags)
        dataset.descriptions = names
    return target


def draw(folder: Path, panels, title: str) -> None:
    """Draw the difference, what exceeds a limit, and the areas of change of a folder of `change`."""
    with rasterio.open(folder / "change.tif") as dataset:
        difference, *_, change = dataset.read()
        cells = round(SMALLEST / dataset.res[0] ** 2)
    beyond = np.where(np.abs(difference) > LIMIT, np.sign(difference), 0)
    signs = 2 * np.nan_to_num(beyond).astype(np.int8)
    beyond = component_sizes(signs, signs != 0) >= cells
    shown = difference, np.where(beyond, difference, np.nan), np.where(change != 0, difference, np.nan)
    names = f"{title}: difference", f"|difference| > {LIMIT:g} m", "areas of change, false alarms 1 %"
    for panel, values, name in zip(panels, shown, names, strict=True):
        panel.imshow(np.where(np.isfinite(difference), 0.8, 1.0), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        drawn = panel.imshow(values, cmap="RdBu", vmin=-8, vmax=8, interpolation="nearest")
        panel.set_title(name, fontsize=10, loc="left")
        panel.set(xticks=[], yticks=[])
    panels[-1].figure.colorbar(drawn, ax=list(panels), shrink=0.8, pad=0.01, label="m")


if __name__ == "__main__":
    before, after, folder, target = map(Path, sys.argv[1:])
    figure = Figure((12, 7.6), layout="constrained")
    rows = figure.subplots(2, 3)
    folder.mkdir(parents=True, exist_ok=True)
    blocks = with_blocks(after / "dsm.tif", folder / "blocks.tif")
    for panels, surface, title in zip(rows, (after, blocks), ("no change", "six blocks"), strict=True):
        sat_intervals.change(before, surface, folder, overwrite=True)
        draw(folder, panels, title)
    figure.savefig(target, dpi=80)
