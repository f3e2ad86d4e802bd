"""Draw the order in which tiles hand on path states, for METHOD.md: ``python docs/pictures/wavefronts.py FILE``."""

import sys

import matplotlib as mpl
import matplotlib.pyplot as plt

from sat_intervals.match.schedule import Schedule, Step
from sat_intervals.tiling import Grid, Window

mpl.use("Agg")
GRID = Grid(Window(0, 0, 4 * 64, 5 * 64), 64)
TITLES = ["from the upper left", "from the upper right", "from the lower right", "from the lower left", "matched"]
# Rows down and columns to the right, by wavefront.
PATHS = [[(0, 1), (1, 1)], [(1, -1), (1, 0)], [(0, -1), (-1, -1)], [(-1, 1), (-1, 0)], []]


def earliest_turns():
    """The earliest turn of each step, where all steps that are ready are done together."""
    schedule, turns, turn = Schedule(GRID, GRID, set().__contains__), {}, 1
    while schedule:
        together = []
        while (step := schedule.next()) is not None:
            together.append(step)
        for step in together:
            turns[step] = turn
            schedule.ended(step)
        turn += 1
    return turns


def main(file):
    """Draw a panel for each wavefront, and one for the tiles."""
    turns = earliest_turns()
    figure, panels = plt.subplots(1, 5, figsize=(15, 2.7), layout="constrained")
    for wavefront, (panel, title, paths) in enumerate(zip(panels, TITLES, PATHS, strict=True)):
        for tile in GRID:
            row, column = tile.grid_row, tile.grid_column
            turn = turns.get(Step(tile, wavefront if wavefront < 4 else None))
            shade = "white" if turn is None else plt.cm.viridis_r(0.08 * turn)
            panel.add_patch(plt.Rectangle((column, row), 1, 1, facecolor=shade, edgecolor="0.2"))
            middle, aside = (column + 0.5, row + 0.5), [sum(ends) for ends in zip(*paths, strict=True)] or (0, 0)
            place = middle[0] - 0.13 * aside[1], middle[1] - 0.13 * aside[0]
            colour = "white" if (turn or 0) > 5 else "black"
            panel.text(*place, turn or "", fontsize=10, color=colour, ha="center", va="center")
            for down, right in paths if turn else ():
                end = middle[0] + 0.42 * right, middle[1] + 0.42 * down
                panel.annotate("", end, middle, arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1})
        panel.set(xlim=(0, 5), ylim=(4, 0), aspect="equal", title=title)
        panel.set_axis_off()
    figure.savefig(file, dpi=72)


if __name__ == "__main__":
    main(sys.argv[1])
