"""Prepare a pair for matching: open and check its images, folder, tiles and store."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sat_intervals.config import Config, Mccnn, load_config, resolved
from sat_intervals.config.weights import weights_file
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels import FINGERPRINT
from sat_intervals.machine import usable_cores
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.mccnn import load_network
from sat_intervals.match.memory import check_memory, check_strips, fitted, strip_bytes, volume_bytes
from sat_intervals.match.normalization import PairStatistics
from sat_intervals.match.search_range import Found
from sat_intervals.raster import (
    BLOCK,
    Image,
    check_pair,
    check_space,
    file_bytes,
    open_image,
    part_bytes,
    read_files,
    run_files,
)
from sat_intervals.raster.identity import check_not_replaced, check_unchanged
from sat_intervals.run.inputs import check_onnxruntime, describe_inputs
from sat_intervals.run.local_ranges import searched
from sat_intervals.run.output import OUTPUTS, check_output, check_replaceable, holds_run, is_complete, replaceable
from sat_intervals.run.parts import codecs_of, parts_of, rows_of_levels
from sat_intervals.run.schedule import blocks_of, handed_bytes
from sat_intervals.run.workers import parse_memory, readers
from sat_intervals.store.before import inputs_before, search_before
from sat_intervals.store.folder import folder_at
from sat_intervals.store.manifest import digest
from sat_intervals.store.marks import finished_run
from sat_intervals.store.parts import Parts
from sat_intervals.store.tiles import LAYOUT, DamagedTilesError, Store
from sat_intervals.tiling import Grid, Tile, Window

Search = Callable[[Image, Image, dict[str, dict[str, Any]]], Found]
"""Finds the search range of two images, whose files have these identities."""

# Settings without effect on tiles; those of the preset itself are listed one by one.
_NOT_OF_TILES = {"preset", "median", "regularization", "products", "cluster"}


@dataclass(frozen=True)
class Job:
    """All that is needed to match any tile of a pair and to assemble its files; picklable.

    Attributes
    ----------
    left, right
        The images.
    config
        Settings.
    store
        Store and grid of the tiles.
    out
        Folder of the run.
    inputs
        Description of the images and of the MC-CNN weights for run.json.
    files
        `identity` of each file that the images are read from, by the name it is opened with.
    requested
        The section ``disparity`` as the user gave it.
    found
        What the search for the range found, None if none was made.
    grid
        Digest of the local search ranges, None without them.
    local
        The local search ranges; not on workers, which read them from the store.
    has_files
        Whether files and a report are made of the tiles; `calibrate` only measures them.
    """

    left: Image
    right: Image
    config: Config
    store: Store
    out: Path
    inputs: dict[str, Any]
    files: dict[str, dict[str, Any]]
    requested: dict[str, Any]
    found: Found | None = None
    grid: str | None = None
    local: LocalRanges | None = None
    has_files: bool = True

    @property
    def manifest(self) -> dict[str, Any]:
        """Return all that decides the bytes of a tile."""
        return _manifest(self.config, self.inputs, self.store.grid.region, self.grid)

    @property
    def hands_states_on(self) -> bool:
        """Return whether tiles hand path states of SGM to their neighbours."""
        return self.config.hands_states_on and len(self.store.grid) > 1

    @property
    def blocks(self) -> Grid:
        """Return the blocks of tiles that are one task, see `blocks_of`; single tiles if they are independent."""
        return blocks_of(self.store.grid, self.config) if self.hands_states_on else self.store.grid

    @property
    def name(self) -> str:
        """Return a unique name of the run: a digest of all that decides the bytes of its files."""
        return digest(self.manifest | {"all": self.config.model_dump(mode="json", exclude={"cluster", "preset"})})

    def is_finished(self) -> bool:
        """Return whether the folder has the files of this run, which was killed before it removed its tiles."""
        noted = finished_run(self.store.home)
        return is_complete(self.out) and noted is not None and noted[0] == self.name

    def begin(self, *, overwrite: bool = False) -> None:
        """Open the store; call it while its folder is locked.

        With ``overwrite`` the files of an earlier run are kept until this one replaces them; to resume, omit it.
        """
        if not overwrite and is_complete(self.out):  # another run may have ended before this one got the lock
            raise holds_run(self.out, OUTPUTS)
        check_output(self.out, overwrite, has_transform=self.left.georeferencing.transform is not None)
        self.store.open(self.manifest, overwrite=overwrite, replaceable=replaceable(self.out, overwrite=overwrite))
        if self.found or self.local:
            search = {"found": self.found and self.found.report(), "ranges": self.local and self.local.report()}
            self.store.write_search(search, _origin(self.inputs))
        if waiting := self.waiting():
            self.store.steps.check_space(self._handed_bytes())
        if self.has_files:
            self.check_space(waiting, len(self.parts().done()))

    def parts(self, codecs: Mapping[str, Any] | None = None) -> Parts:
        """Return the parts of the files; ``codecs`` are those that make them, by default those of this process."""
        return parts_of(self.store, self.name, codecs or codecs_of(self.config))

    def check_space(self, tiles: Sequence[Tile], parts: int) -> None:
        """Raise if local disks have no room for what a run has yet to write.

        Parameters
        ----------
        tiles
            The tiles that are not done.
        parts
            Number of parts of the files that are done.

        Raises
        ------
        OutputError
            Gives free and needed space.
        """
        region = self.store.grid.region
        files = run_files(self.config.products.compression)
        final = file_bytes(files, region.height, region.width)
        share = 1 - parts / sum(rows_of_levels(region))
        before = self.store.stored_bytes(tiles) + round(share * part_bytes(files, region.height, region.width))
        if tiles:
            before += self.store.steps.missing_bytes(self._handed_bytes())
        if self.store.elsewhere is None:
            check_space(self.out, before + final, "tiles, files and their parts")
            return
        check_space(self.out, final, "files")
        place = self.store.folder.place("")
        if isinstance(place, Path):
            check_space(place, before, "tiles and parts of files")

    def _handed_bytes(self) -> int:
        return handed_bytes(self.store.grid, self.config, (self.left, self.right))

    def check_inputs(self) -> None:
        """Raise if an input changed since the start of the run, or this process has another onnxruntime.

        Raises
        ------
        ChangedInputError
            Names the first changed input.
        """
        check_unchanged(self.files)
        check_onnxruntime(self.inputs)

    def statistics(self) -> PairStatistics | None:
        """Return mean and standard deviation of both images, None if the run needs none.

        Raises
        ------
        DamagedTilesError
            They are missing in the store; a retry restores them.
        """
        if not self.config.cost.needs_statistics:
            return None
        normalization = self.store.normalization()
        if normalization is None:
            raise DamagedTilesError(
                f"the image statistics in {self.store.folder} are missing: rerun the same command: it resumes"
            )
        return PairStatistics.of_report(normalization)

    def ranges(self) -> LocalRanges | None:
        """Return the local search ranges, None without them.

        Raises
        ------
        DamagedTilesError
            They are missing in the store.
        """
        if not self.config.disparity.is_local:
            return None
        if self.local is None:
            stored = (self.store.search(_origin(self.inputs)) or {}).get("ranges")
            if stored is None or digest(stored) != self.grid:
                raise DamagedTilesError(
                    f"the local search ranges in {self.store.folder} are missing: rerun the same command: it resumes"
                )
            return LocalRanges.of_report(stored)
        return self.local

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what workers read from the store, see `ranges`."""
        return self.__dict__ | {"local": None}

    def waiting(self) -> list[Tile]:
        """Return the tiles that are not done."""
        done = self.store.done()
        return [tile for tile in self.store.grid if tile.name not in done]


def prepare(
    left: str | Path | Image,
    right: str | Path | Image,
    out: str | Path,
    config: Any,
    *,
    window: Window | None = None,
    overwrite: bool = False,
    pair: str = "",
    find: Search | None = None,
) -> Job:
    """Check all that can be checked before tiles are matched; parameters as in `match_pair`.

    ``pair`` distinguishes otherwise equal pairs of a batch in an external store. ``find`` finds a search range that is
    not given; one that an interrupted run has found is taken over.
    """
    config = resolved(load_config(config))
    out = Path(out)
    requested = config.disparity.model_dump(mode="json")
    left, right = checked_pair(left, right, config)
    region = checked_region(left, window)
    if not config.disparity.is_auto:
        check_tiles(fitted_to_jobs(config), region)
    check_output(out, overwrite, has_transform=left.georeferencing.transform is not None)
    home = out / "tiles"
    inputs, files = describe_inputs(left, right, config, inputs_before(home, config.cluster.store))
    before = None if overwrite else _found_before(home, config.cluster.store, inputs)
    config, found, local = searched(config, left, lambda: before or _find(find, left, right, files))
    marked = digest(local.report()) if local else None
    checked_pair(left, right, config)
    config = fitted_to_jobs(config)
    check_tiles(config, region)
    ranges = config.disparity.grid
    read = [*files, *(read_files(ranges) if ranges else ()), inputs["weights"]["path"] if "weights" in inputs else None]
    run = digest(_manifest(config, inputs, region, marked))
    elsewhere = _elsewhere(config.cluster.store, home, "-".join(filter(None, (pair, run))))
    # folders of runs in a local store: their names end with a digest
    stores = Path(elsewhere).parent.glob("*" + 32 * "[0-9a-f]") if elsewhere and "://" not in elsewhere else ()
    check_not_replaced(read, [out / name for name in OUTPUTS], [home, *stores])
    if overwrite:
        check_replaceable(out)
    grid = Grid(region, config.tiles.size)
    count = config.disparity.count
    most = config.largest_ambiguity
    levels = config.subpixel_levels
    has_seams = config.tiles.overlap != "exact"
    store = Store(home.absolute(), grid, count, most, levels, has_seams, run, elsewhere)
    return Job(left, right, config, store, out, inputs, files, requested, found, marked, local)


def _elsewhere(store: str | None, home: Path, name: str) -> str | None:
    """Return the folder of a run in the store that the user names, None if its tiles are at home."""
    if not store or folder_at(store) == folder_at(home):
        return None
    return str(folder_at(store).inside(name))


def _find(find: Search | None, left: Image, right: Image, files: dict[str, dict[str, Any]]) -> Found:
    if find is None:
        raise SatIntervalsError("the search range is auto: give it as numbers")
    return find(left, right, files)


def _origin(inputs: Mapping[str, Any]) -> str:
    """Return a digest of all that decides which search range is found."""
    images = {side: inputs[side] for side in ("left", "right")}
    return digest({"version": _version(), "kernels": FINGERPRINT, "inputs": images})


def _found_before(home: Path, store: str | None, inputs: Mapping[str, Any]) -> Found | None:
    """Return the search range that an interrupted run of the same images has stored, None without one."""
    search = search_before(home, store, _origin(inputs))
    return Found.of_report(search["found"]) if search and search["found"] else None


@cache
def _version() -> str:
    """Return the version of this package; reading it takes 2 ms, and each tile compares manifests."""
    return version("sat-intervals")


def _manifest(config: Config, inputs: Mapping[str, Any], region: Window, grid: str | None) -> dict[str, Any]:
    """Return all that decides the bytes of a tile; of a calibration only its levels."""
    settings = config.model_dump(mode="json", exclude=_NOT_OF_TILES)
    levels = config.cuts
    if levels is not None:
        settings["interval"] = {"high": levels.high, "low": levels.low, "steps": config.bound_steps}
    return {
        **({"local_ranges": grid} if grid else {}),
        "version": _version(),
        "kernels": FINGERPRINT,
        "layout": LAYOUT,
        "settings": settings,
        "inputs": inputs,
        "region": asdict(region),
    }


def fitted_to_jobs(config: Config) -> Config:
    """Return the settings with tiles small enough for the memory of a job of a batch system.

    Raises
    ------
    ConfigError
        See `fitted` and `parse_memory`.
    """
    memory = None if config.disparity.is_auto else _job_bytes(config)
    return config if memory is None else fitted(config, memory, config.cluster.cores, readers(config.cluster))


def _job_bytes(config: Config) -> int | None:
    """Return the memory of a job of a batch system for the tiles being matched: dask kills workers at 95 %."""
    if config.cluster.memory is None:
        return None
    return 9 * parse_memory(config.cluster.memory) // 10


def checked_pair(left: str | Path | Image, right: str | Path | Image, config: Config) -> tuple[Image, Image]:
    """Open the images of a pair and check that they can be matched."""
    left, right = (image if isinstance(image, Image) else open_image(image) for image in (left, right))
    check_pair(left, right, 1 if config.disparity.is_auto else config.disparity.count)
    if not config.disparity.is_auto:
        config.disparity.check_images(left.path, left.width, right.path, right.width)
    if isinstance(config.cost, Mccnn):
        load_network(weights_file(config.cost.weights))
    return left, right


def checked_region(left: Image, window: Window | None) -> Window:
    """Return the region of the left image to match: the given window, or all of it."""
    whole = Window(0, 0, left.height, left.width)
    if window is None:
        return whole
    if window.height < 1 or window.width < 1 or window.clipped(whole) != window:
        raise SatIntervalsError(
            f"window at row {window.row}, column {window.column}, {window.height} x {window.width} pixels: "
            f"must be inside {left.path}, {left.height} x {left.width} pixels"
        )
    return window


def check_tiles(config: Config, region: Window) -> None:
    """Raise if tiles and strips do not fit in the memory of this machine or of a job; schedulers have their own."""
    rows = min(BLOCK, region.height)
    memory = _job_bytes(config)
    if memory is not None:
        check_strips(rows, region.width, config, memory, config.cluster.cores)
    if config.cluster.kind not in ("threads", "processes"):
        return
    height, width = (min(config.tiles.size, side) for side in (region.height, region.width))
    most = config.cluster.workers or usable_cores()
    tiles, strips = min(most, len(Grid(region, config.tiles.size))), min(most, -(-region.height // BLOCK))
    check_memory(
        tiles * volume_bytes(height, width, config),
        f"tiles of {height} x {width} pixels x {config.disparity.count} disparities, {tiles} at once,",
        "choose a smaller --tile-size or fewer --workers",
    )
    check_memory(
        strips * strip_bytes(rows, region.width, config.products.compression),
        f"strips of {rows} x {region.width} pixels, {strips} at once,",
        "choose fewer --workers or a narrower --window",
    )
