"""Find the search range of a pair: both images are reduced block by block, and matched from coarse to fine."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sat_intervals.kernels.resampling import Step, reduced
from sat_intervals.match import coarse
from sat_intervals.match.coarse import Found, NoRangeError
from sat_intervals.match.memory import check_memory
from sat_intervals.match.normalization import BLOCK, blocks
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.prepare.pair import Each, Pair
from sat_intervals.tiling import Grid, Window

UNDECLARED = 0.01
"""Share of the pixels of an image that make an undeclared no-data border worth a warning."""
_TASK = 500  # bytes of the window and the task of a block


def found_range(pair: Pair, each: Each) -> Found:
    """Find the search range of a pair from the whole images, with its evidence; NoRangeError without enough matches."""
    for name, (rows, columns) in zip(pair.names, pair.shapes, strict=True):
        number = len(Grid(Window(0, 0, rows, columns), BLOCK))
        check_memory(_TASK * number, f"{name}: {rows} x {columns} pixels in {number} blocks", "is it the right file?")
    compile_kernels(coarse.settings(0, 3))
    step = coarse.finest_step(pair.shapes[0][0], max(columns for _, columns in pair.shapes))
    small, undeclared = [], dict[str, Any]()
    for side, name in enumerate(("left", "right")):
        pixels, smallest = _reduced(pair, side, step, each)
        found = coarse.undeclared_border(pixels, smallest)
        if pair.is_plain(side) and found.mean() > UNDECLARED:
            undeclared[name] = {"value": smallest, "share": round(float(found.mean()), 4)}
            pixels[found] = np.nan
        small.append(pixels)
    try:
        search = coarse.find_range(small[0], small[1], step, pair.shapes[0])[0].fitted(pair.shapes[1][1])
    except NoRangeError as error:
        hints = "".join(f"; {line}" for line in undeclared_lines(undeclared, pair.names))
        raise NoRangeError(
            f"{pair.names[0]} and {pair.names[1]}: {error}{hints}: give the search range with --disparity MIN MAX (in "
            "Python disparity minimum and maximum), or check that the images are an epipolar pair: raw ones go to "
            "sat-intervals surface, or to rectify first, with the --altitude of the ground"
        ) from None
    return replace(search, undeclared=undeclared)


def reduce_block(pair: Pair, side: int, block: Window, step: Step) -> tuple[np.ndarray, float]:
    """Return a block of an image at the finest level, and its smallest usable pixel; runs on a worker."""
    _, pixels, state = pair.view(side, block)
    smallest = pixels.min(where=state == 0, initial=np.inf)
    return reduced(pixels, state, step), float(smallest)


def _reduced(pair: Pair, side: int, step: Step, each: Each) -> tuple[np.ndarray, float]:
    """An image at the finest level, and its smallest usable value."""
    rows, columns = pair.shapes[side]
    windows = [block for block in blocks(rows, columns) if block.height >= step.rows and block.width >= step.columns]
    small = np.full((rows // step.rows, columns // step.columns), np.nan, np.float32)
    smallest = np.inf
    for number, (pixels, least) in each(reduce_block, [(pair, side, block, step) for block in windows], "range"):
        row, column = windows[number].row // step.rows, windows[number].column // step.columns
        small[row : row + pixels.shape[0], column : column + pixels.shape[1]] = pixels
        smallest = min(smallest, least)
    return small, smallest


def undeclared_lines(undeclared: Mapping[str, Any], names: tuple[str, str]) -> list[str]:
    """Return warnings of no data along the borders of images that nothing declares."""
    return [
        f"{name}: {100 * border['share']:.0f} % of the pixels are exactly {border['value']:.9g}, along its borders, "
        f"and no no-data value is declared: if it is no data, give --nodata {border['value']:.9g}"
        for side, name in zip(("left", "right"), names, strict=True)
        if (border := undeclared.get(side))
    ]
