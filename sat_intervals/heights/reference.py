"""Turn reference heights into true disparities of a run: ``truth.tif``, for `calibrate` and `evaluate`.

Rasters are seen pixel by pixel; points go through inverse location. Both are registered to the heights of the run.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.geometry import FILE, Geometry, geometry_of
from sat_intervals.heights.lattice import Lattice, on_map
from sat_intervals.heights.location import GroundLattice, Location
from sat_intervals.heights.point_files import PointFile
from sat_intervals.heights.point_sight import PointVisibility
from sat_intervals.heights.raster_visibility import RasterVisibility
from sat_intervals.heights.registering import blocks_of_points, blocks_of_raster
from sat_intervals.heights.sensors import check_cover, lattice_of
from sat_intervals.kernels.registration import LEAST, Registration, register
from sat_intervals.progress import Progress
from sat_intervals.raster import HeightRaster, OutputWriter, Projection, Vertical, truth_file, utm_of
from sat_intervals.raster.layers import tag_of_left
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import Window

_SAMPLE = 100_000  # points to register with, chosen at random
_AROUND = 500.0  # metres around the region's ground in which points are read
_CHECKED = 9  # positions along both axes of a region at which the row misfit is measured
# Correlation of disparities and truth below which left and right are swapped, and pixels that it takes.
_SWAPPED, _ENOUGH = -0.5, 500


@dataclass(frozen=True)
class Reference:
    """Reference heights: a raster, or points (CSV, LAS, LAZ, vector files); ``crs`` replaces that of the file."""

    path: Path
    is_points: bool
    vertical: Vertical
    crs: str | None = None


def make_truth(
    out: str | Path,
    reference: Reference,
    *,
    path: Path | None = None,
    registers: bool = True,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Write the disparities that reference heights have in a run, by default to ``truth.tif`` in its folder.

    `set_geometry` has named models and grids of the run. With ``registers`` the reference is first moved by its
    constant shift from the heights of the run.

    Returns ``pixels`` with a true disparity, and their share of the run, ``share``; ``outside_range``, the share of
    them outside the search range; ``row_misfit``, median and largest distance in pixels between the rows at which both
    images show a point; ``correlation`` of disparity and truth over valid pixels, None for few; ``registration``, see
    `Registration.report`.
    """
    run = open_run(out)
    path = run.out / "truth.tif" if path is None else path
    geometry = geometry_of(run, progress)
    run.check_kept([path], [*geometry.files, reference.path, run.out / FILE])
    work = _Work(geometry, reference)
    found = work.registration(progress) if registers else None
    shift = np.zeros(3) if found is None else found.shift
    tags = {
        "RUN": run.report["finished"],
        "REFERENCE": str(reference.path),
        "REGION": run.region.in_words,
        "SOFTWARE": "sat-intervals",
        "SHIFT": " ".join(f"{part:.3f}" for part in shift) + " m",
    }
    tags |= tag_of_left(run.report["inputs"]["left"])
    tally = _PixelCounts(run)
    with (
        OutputWriter(path.parent, [truth_file(path.name)], *run.shape, run.georeferencing, tags) as writer,
        TemporaryFile(dir=path.parent) as file,
    ):
        for row, strip in work.strips(shift, file, progress):
            writer.write(row, strip[np.newaxis].astype(np.float32))
            tally.add(row, strip)
        tally.check(reference.path, work.place)
        progress("files", 0, 1)
        writer.publish()
        progress("files", 1, 1)
    return tally.report() | {"row_misfit": work.row_misfit, "registration": found and found.report()}


class _Work:
    """A run, its geometry, and the opened reference."""

    def __init__(self, geometry: Geometry, reference: Reference) -> None:
        run, sensors = geometry.run, geometry.sensors
        self.run = run
        self._sensors = sensors
        self._lattice = geometry.lattice
        self._path = reference.path
        search, region = run.config.disparity, run.region
        self._search = search.minimum, search.maximum
        self._location = Location(sensors)
        rows = np.linspace(region.row, region.row_stop - 1, _CHECKED)
        columns = np.linspace(region.column, region.column_stop - 1, _CHECKED)
        row, column, disparity = (axis.ravel() for axis in np.meshgrid(rows, columns, self._search, indexing="ij"))
        ground = sensors.triangulate(row, column, disparity)
        seen = self._location.positions(*ground[:, :3].T)
        lower = run.rows.at(row, seen[:, 3]) if run.rows else 0.0
        misfit = np.abs(seen[:, 2] - seen[:, 0] - lower)[np.isfinite(seen).all(axis=1)]
        self.row_misfit = (float(np.median(misfit)), float(misfit.max())) if misfit.size else None
        self._ground = ground[np.isfinite(ground).all(axis=1), :3]
        if not len(self._ground):
            raise SatIntervalsError(f"the models have no points for {run.out}: check models and grids")
        self.place = float(np.median(self._ground[:, 0])), float(np.median(self._ground[:, 1]))
        self._projection = Projection(utm_of(*self.place))
        self._pixel, self._rise = self._scale()
        opener = PointFile if reference.is_points else HeightRaster
        self._heights = opener(reference.path, reference.crs, reference.vertical)
        self._heights.frame.check(*self.place)

    def _scale(self) -> tuple[float, float]:
        """Return metres of a pixel on the ground, and the change of disparity for a height of as many metres."""
        region = self.run.region
        row, column = region.row + region.height / 2, region.column + region.width / 2
        middle = sum(self._search) / 2
        ends = self._sensors.triangulate(np.full(3, row), column + np.array([0, 1, 0]), middle + np.array([0, 0, 1]))
        x, y = self._projection.place(ends[:, 0], ends[:, 1])
        pixel = float(np.hypot(x[1] - x[0], y[1] - y[0]))
        return pixel, pixel / float(ends[2, 2] - ends[0, 2])

    def registration(self, progress: Progress) -> Registration:
        """Return the shift from the reference to the heights of the run."""
        progress("registration", 0, 1)
        lattice = on_map(self._lattice, self._projection, str(self.run.out))
        if isinstance(self._heights, HeightRaster):
            blocks = blocks_of_raster(self.run, lattice, self._heights, self._projection, self._pixel)
        else:
            blocks = blocks_of_points(self.run, lattice, self._sample(progress), self._pixel)
        found = register(blocks)
        if found is None:
            raise SatIntervalsError(
                f"{self._path} has fewer than {LEAST} heights where {self.run.out} has valid pixels, at "
                f"{_degrees(self.place)}: give a reference of the same place, more points, or --no-register"
            )
        progress("registration", 1, 1)
        return found

    def _near(self, progress: Progress) -> Iterator[np.ndarray]:
        """Yield points near the run's ground: ``(n, 3)`` easting, northing, height above the ellipsoid."""
        assert isinstance(self._heights, PointFile)
        x, y = self._projection.place(self._ground[:, 0], self._ground[:, 1])
        done = 0
        for part in self._heights.parts():
            longitude, latitude, height = self._heights.frame.to_ellipsoid(*part.T)
            places = np.column_stack([*self._projection.place(longitude, latitude), height])
            near = np.isfinite(places).all(axis=1)
            for axis, ends in ((0, x), (1, y)):
                near &= (places[:, axis] > ends.min() - _AROUND) & (places[:, axis] < ends.max() + _AROUND)
            done += len(part)
            progress("reference", done, 1)
            yield places[near]

    def _sample(self, progress: Progress) -> np.ndarray:
        """Return points near the run, `_SAMPLE` at most, each with the same chance."""
        random = np.random.default_rng(0)
        kept, keys = np.empty((0, 3)), np.empty(0)
        for part in self._near(progress):
            kept, keys = np.concatenate([kept, part]), np.concatenate([keys, random.random(len(part))])
            if len(kept) > _SAMPLE:
                least = np.argpartition(keys, _SAMPLE)[:_SAMPLE]
                kept, keys = kept[least], keys[least]
        return kept

    def strips(self, shift: np.ndarray, file: BinaryIO, progress: Progress) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the first row and the true disparities of strips from the top; points are kept in an empty file."""
        if isinstance(self._heights, HeightRaster):
            right_width = self.run.report["inputs"]["right"]["width"]

            def wider(minimum: int, maximum: int) -> Lattice:
                check_cover(self._sensors, self.run.region, right_width, minimum, maximum)
                return lattice_of(self._sensors, self.run.region, minimum, maximum)

            sight = RasterVisibility(self._lattice, wider, self._heights, self._projection, shift, self._search)
            strips = sight.strips(self._pixel)
        else:
            strips = self._points_seen(shift, file, progress).strips()
        for row, strip in strips:
            progress("truth", row + len(strip), self.run.region.height)
            yield row, strip

    def _points_seen(self, shift: np.ndarray, file: BinaryIO, progress: Progress) -> PointVisibility:
        """Return what is seen of the points near the run, which are read twice: the lattice is around all of them."""
        sight = PointVisibility(file, self.run.region, self._rise)
        lowest, highest = np.full(3, np.inf), np.full(3, -np.inf)
        for part in self._near(progress):
            lowest = np.minimum(lowest, part.min(axis=0, initial=np.inf))
            highest = np.maximum(highest, part.max(axis=0, initial=-np.inf))
        if np.isfinite(lowest).all():
            lattice = GroundLattice(self._location, self._projection, lowest + shift, highest + shift, self._pixel)
            for part in self._near(progress):
                row, column, _, right = lattice.positions(part + shift).T
                sight.add(row, column, right - column)
        return sight


def _degrees(place: tuple[float, float]) -> str:
    return f"longitude {place[0]:.3f}, latitude {place[1]:.3f}"


class _PixelCounts:
    """Compare true disparities with those of the run."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._pixels = self._outside = 0
        self._sums = np.zeros(6)

    def add(self, row: int, truth: np.ndarray) -> None:
        known = np.isfinite(truth)
        search = self._run.config.disparity
        self._pixels += int(known.sum())
        self._outside += int(((truth < search.minimum) | (truth > search.maximum)).sum())
        if known.any():
            bands = self._run.read_bands(Window(row, 0, *truth.shape))
            both = known & bands.valid & np.isfinite(bands.disparity)
            one, other = truth[both], bands.disparity[both].astype(np.float64)
            self._sums += [one.size, one.sum(), other.sum(), one @ one, other @ other, one @ other]

    @property
    def correlation(self) -> float | None:
        """Return the correlation of disparity and truth; None for few pixels or flat ground."""
        count, one, other, one_one, other_other, one_other = self._sums
        if count < _ENOUGH:
            return None
        spread = (one_one - one**2 / count) * (other_other - other**2 / count)
        return float((one_other - one * other / count) / np.sqrt(spread)) if spread > 0 else None

    def check(self, path: Path, place: tuple[float, float]) -> None:
        """Raise if there is no true disparity, or if they fall where those of the run rise."""
        if not self._pixels:
            raise SatIntervalsError(
                f"no pixel of {self._run.out} sees a height of {path}: the run is at {_degrees(place)}; give a "
                "reference of this place, in its CRS"
            )
        correlation = self.correlation
        if correlation is not None and correlation < _SWAPPED:
            raise SatIntervalsError(
                f"the heights of {path} rise where the disparities of {self._run.out} fall (correlation "
                f"{correlation:.2f}): models and grids of left and right are swapped, or the left "
                "and right images are"
            )

    def report(self) -> dict[str, Any]:
        rows, columns = self._run.shape
        return {
            "pixels": self._pixels,
            "share": self._pixels / (rows * columns),
            "outside_range": self._outside / self._pixels,
            "correlation": self.correlation,
        }
