"""The figures of docs/range.md: found ranges and local ranges on the pairs with truth of ``SAT_INTERVALS_SHARED``."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from sat_intervals import match_arrays
from sat_intervals.kernels.resampling import reduced
from sat_intervals.match.coarse import Found, find_range, finest_step
from sat_intervals.match.local_ranges import LocalRanges

DATA = Path(os.environ.get("SAT_INTERVALS_SHARED", "../shared")) / "data"
# Columns of the tables.
RANGE = "| pair | found | truth inside | width, of the true one | local: truth inside | local: share of the range |"
MATCH = "| pair | kept | kept, local | bad-1 | bad-1, local | coverage | coverage, local |"


def read(file: Path) -> np.ma.MaskedArray:
    """Read the pixels of a raster."""
    with rasterio.open(file) as dataset:
        return dataset.read(1, masked=True)


def found_in(left: np.ma.MaskedArray, right: np.ma.MaskedArray) -> Found:
    """Find the range of a pair."""
    step = finest_step(left.shape[0], max(left.shape[1], right.shape[1]))
    small = [reduced(image.filled(0), np.ma.getmaskarray(image).view(np.uint8), step) for image in (left, right)]
    return find_range(small[0], small[1], step, left.shape)[0]


def at_pixels(ranges: LocalRanges, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the cell of each pixel."""
    rows, columns = (np.arange(side) // size for side, size in zip(shape, (ranges.height, ranges.width), strict=True))
    return ranges.minimum[np.ix_(rows, columns)], ranges.maximum[np.ix_(rows, columns)]


def range_row(name: str, found: Found, truth: np.ndarray) -> tuple[str, float]:
    """Return the row of a pair in the first table, and the share of its local ranges."""
    known = np.isfinite(truth)
    inside = np.mean((truth[known] >= found.minimum) & (truth[known] <= found.maximum))
    low, high = np.quantile(truth[known], [0.0005, 0.9995])
    least, most = at_pixels(found.local, truth.shape)
    local = np.mean(((truth >= least) & (truth <= most))[known])
    count = found.maximum - found.minimum + 1
    share = float(np.mean(most.astype(int) - least + 1) / count)
    width = (count - 1) / (high - low + 1)
    return (
        f"| {name} | {found.minimum} to {found.maximum} | {inside:.4f} | {width:.2f} | {local:.4f} | {share:.2f} |",
        share,
    )


def figures(left: Any, right: Any, truth: np.ndarray, search: dict[str, Any]) -> list[float]:
    """Return the share of pixels kept, of them wrong by more than 1 px, and of their intervals with the truth."""
    found = match_arrays(left, right, {"preset": "paper", "disparity": search})
    disparity, lower, upper = (found[name].values for name in ("disparity", "lower", "upper"))
    kept = np.isfinite(disparity) & np.isfinite(truth)
    bad = np.abs(disparity - truth)[kept] > 1
    inside = ((lower <= truth) & (truth <= upper))[kept]
    return [float(np.isfinite(disparity).mean()), float(bad.mean()), float(inside.mean())]


def main() -> None:
    """Print both tables."""
    ranges, matches, shares = [RANGE, "|---|---|---|---|---|---|"], [MATCH, "|---|---|---|---|---|---|---|"], []
    for folder in sorted(path.parent for path in DATA.glob("*/truth.tif")):
        left, right = read(folder / "left.tif"), read(folder / "right.tif")
        found = found_in(left, right)
        truth = read(folder / "truth.tif").filled(np.nan)
        row, share = range_row(folder.name, found, truth)
        ranges.append(row)
        shares.append(share)
        pairs = zip(*(figures(left, right, truth, {"local": local}) for local in (False, True)), strict=True)
        matches.append(f"| {folder.name} | " + " | ".join(f"{value:.3f}" for pair in pairs for value in pair) + " |")
    print("\n".join([*ranges, "", f"mean share of local ranges: {np.mean(shares):.3f}", "", *matches]))


if __name__ == "__main__":
    main()
