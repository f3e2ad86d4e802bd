"""How the interval of a cell is made from its points, and which points and cells are left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from sat_intervals.config import HeightCalibration, Interval
from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.polygons import read_areas
from sat_intervals.raster.completion import Completion

Bounds = Literal["envelope", "quantiles"]
BOUNDS: tuple[Bounds, ...] = get_args(Bounds)
# Cells to the rim of a void: nearer ones have fewer directions; tiles are read with twice as many around them.
_REACH = 2, 256


@dataclass(frozen=True)
class SurfaceChoices:
    """What `make_surface` does with points and cells.

    Attributes
    ----------
    bounds
        Interval of a cell: ``envelope`` contains those of all its points; ``quantiles`` goes from the .3
        quantile of their lower bounds to the .7 quantile of their upper bounds, and contains the cell's height. None:
        ``quantiles`` for runs with a coverage, else ``envelope``.
    keeps_open
        Whether points whose interval is open at an end of the search range contribute. None: not with a coverage.
    keeps_border
        Whether points beside missing data of the right image contribute whose confidence is below 0.1.
    outliers, max_width
        Metres: leave out points farther from the median of the points within 2 pixels, and cells with a wider interval.
    min_confidence
        Leave out cells of lower confidence, 0 to 1.
    calibration
        Margins that move the bounds, before wide intervals are left out.
    aligns, reference
        Whether several runs are moved onto each other first, and a raster of heights, above the same datum, that each
        run is moved onto.
    ortho
        Whether ``ortho.tif`` is written beside the surface: the raw images of the first run, of many images their
        median, resampled to it.
    fill
        Metres up to which voids are filled from their rims. None: voids are no data.
    flatten, mask
        Polygons, or a raster that is not 0 inside: areas of one height, that of a low part of their rims, and areas of
        no data.
    """

    bounds: Bounds | None = None
    keeps_open: bool | None = None
    keeps_border: bool = False
    outliers: float | None = None
    max_width: float | None = None
    min_confidence: float | None = None
    calibration: HeightCalibration | None = None
    aligns: bool = True
    reference: Path | None = None
    ortho: bool = False
    fill: float | None = None
    flatten: Path | None = None
    mask: Path | None = None

    def __post_init__(self) -> None:
        if self.bounds is not None and self.bounds not in BOUNDS:
            raise SatIntervalsError(f"bounds is {self.bounds!r}, allowed: {', '.join(BOUNDS)}")
        if self.reference and not self.aligns:
            raise SatIntervalsError("runs are moved onto a reference: leave it out, or let them be aligned")
        for name, value in (("outliers", self.outliers), ("max_width", self.max_width), ("fill", self.fill)):
            if value is not None and not 0 < value < float("inf"):
                raise SatIntervalsError(f"{name} is {value:g} m: give one above 0, or leave it out")
        if self.min_confidence is not None and not 0 <= self.min_confidence <= 1:
            raise SatIntervalsError(f"min_confidence is {self.min_confidence:g}: give one from 0 to 1")

    def for_intervals(self, intervals: Sequence[Interval | None]) -> "SurfaceChoices":
        """Return the choices with the defaults of runs, which depend on whether all have a coverage."""
        covered = all(interval is not None and interval.coverage is not None for interval in intervals)
        return replace(
            self,
            bounds=self.bounds or ("quantiles" if covered else "envelope"),
            keeps_open=not covered if self.keeps_open is None else self.keeps_open,
        )

    def tags(self) -> dict[str, str]:
        """Return tags of the surface: its bounds, and what was left out."""
        limits = {"OUTLIERS": (self.outliers, " m"), "MAX_WIDTH": (self.max_width, " m")}
        limits |= {"MIN_CONFIDENCE": (self.min_confidence, "")}
        tags = {name: f"{value:g}{unit}" for name, (value, unit) in limits.items() if value is not None}
        return {"INTERVAL": str(self.bounds), **tags, **({} if self.keeps_open else {"OPEN_POINTS": "left out"})}


def completion_of(cell: float, choices: SurfaceChoices) -> Completion | None:
    """Read what completes a surface with cells of a side in metres; None if it stays as it was measured."""
    fill, files = choices.fill, (choices.flatten, choices.mask)
    if not (fill or any(files)):
        return None
    nearest, farthest = (cells * cell for cells in _REACH)
    if fill and not nearest <= fill <= farthest:
        raise SatIntervalsError(f"fill distance is {fill:g} m: give {nearest:g} to {farthest:g} m, 2 to 256 cells")
    return Completion(fill, *(read_areas(path) if path else None for path in files))
