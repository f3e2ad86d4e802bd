"""Prepare a pair for matching: images, search range, inputs, tiles, and the state of its folder."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

from sat_intervals.config import Config, Volume, load_config, resolved
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.kernels import FINGERPRINT
from sat_intervals.kernels.rows import RowOffsets
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import VolumeOf
from sat_intervals.match.normalization import PairStatistics
from sat_intervals.match.rows import Survey
from sat_intervals.match.schedule import blocks_of, handed_bytes
from sat_intervals.match.search_range import Found
from sat_intervals.raster import (
    Image,
    check_space,
    file_bytes,
    files_of,
    part_bytes,
)
from sat_intervals.raster.identity import check_not_replaced
from sat_intervals.run.checks import check_tiles, checked_pair, checked_region, fitted_to_jobs
from sat_intervals.run.inputs import describe_inputs, identities
from sat_intervals.run.local_ranges import searched
from sat_intervals.run.state import OUTPUTS, check_folder, files_of_run, next_step, read_report
from sat_intervals.run.workers import is_remote
from sat_intervals.store.folder import folder_at
from sat_intervals.store.manifest import MANIFEST, PLACE, StoreError, digest, place_of, read_manifest, write_manifest
from sat_intervals.store.tiles import LAYOUT, ONCE, PARTS, TILES, DamagedTilesError, Store, home_of, store_bytes
from sat_intervals.tiling import Grid, Tile, Window


class Finds(Protocol):
    """Finds what a pair needs before its tiles."""

    def search_range(self, left: Image, right: Image) -> Found:
        """Find the search range."""

    def survey(self, left: Image, right: Image, region: Window, search: tuple[int, int]) -> Survey:
        """Look at blocks of a region over a search range."""


# Settings without effect on tiles; those of the preset itself are listed one by one.
_NOT_OF_TILES = {"preset", "rows", "median", "regularization", "products", "cluster"}
# Files of `ONCE`.
_STATISTICS, _RANGE = "statistics", "range"
_REMOTE = "check URL and credentials, and pip install the package of its file system ('sat-intervals[remote]' for S3)"
_NO_TILES = Grid(Window(0, 0, 0, 0), 1)


@dataclass(frozen=True)
class Job:
    """All that is needed to match any tile of a pair and to assemble its files; picklable.

    ``requested`` is the section ``disparity`` as given, ``found`` the result of the search for a range, ``local`` the
    local ranges, which workers read from the store. With ``overwrite``, files and another run in ``out`` may be
    replaced. `calibrate` makes no files of its tiles: ``has_files`` is False. ``volume_of`` makes the volumes of
    another matcher; its name is in the settings. ``missed``: see `Survey.missed`.
    """

    left: Image
    right: Image
    config: Config
    store: Store
    out: Path
    inputs: dict[str, Any]
    requested: dict[str, Any]
    found: Found | None = None
    survey: Survey | None = None
    ranges_digest: str | None = None
    local: LocalRanges | None = None
    missed: str = ""
    overwrite: bool = False
    has_files: bool = True
    volume_of: VolumeOf | None = None

    @property
    def manifest(self) -> dict[str, Any]:
        """Return all that decides the bytes of a tile, and where the tiles are."""
        made = _manifest(self.config, self.inputs, self.store.grid.region, self.ranges_digest, self.right.rows)
        return made | {PLACE: None if self.is_home else str(self.store.folder)}

    @property
    def is_home(self) -> bool:
        """Return whether the tiles are in the folder of the run."""
        return self.store.folder == folder_at(home_of(self.out))

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
        """Return the name of the run: a digest of all that decides the bytes of its files."""
        return digest(self.manifest | {"all": self.settings})

    @property
    def settings(self) -> dict[str, Any]:
        """Return the settings that decide the bytes of the files."""
        return self.config.model_dump(mode="json", exclude={"cluster", "preset"})

    def begin(self) -> bool:
        """Open the store and return True; False if the run is complete. Call it while the folder is locked."""
        step = next_step(self.out, self.manifest, self.name, self.settings, overwrite=self.overwrite)
        if step == "complete":
            return False
        if step == "start anew":
            remove_tiles(self.out)
        try:
            self.store.write(ONCE, "begun")  # fails at once where nothing can be written
            if step != "resume":
                write_manifest(home_of(self.out), self.manifest)
            if self.found or self.local or self.survey:
                found, ranges = self.found and self.found.report(), self.local and self.local.report()
                of, survey = origin_of(self.inputs), self.survey and self.survey.report()
                self.store.write(ONCE, _RANGE, of=of, found=found, ranges=ranges, survey=survey)
        except OSError as error:
            way_out = "make room, check its rights or choose another folder" if self.store.folder.is_local else _REMOTE
            raise StoreError(f"{self.store.folder} cannot be used: {error.strerror or error}: {way_out}") from error
        self._check_space()
        return True

    def _check_space(self) -> None:
        """Raise if disks have no room for what a run has yet to write."""
        region, files = self.store.grid.region, files_of_run(self.config)
        share = len(self.waiting()) / len(self.store.grid)
        tiles = store_bytes(self.store.grid, has_coverage=self.config.has_coverage)
        handed = handed_bytes(
            self.store.grid, self.config, (self.left, self.right), keeps_pixels=not is_remote(self.config.cluster)
        )
        parts = self.has_files * part_bytes(files, region.height, region.width)
        before = share * (tiles + handed) + max(0, parts - sum(self.store.folder.sizes(PARTS).values()))
        final = self.has_files * file_bytes(files, region.height, region.width)
        if self.is_home:
            check_space(self.out, round(before + final), "tiles, files and their parts")
            return
        check_space(self.out, final, "files")
        if self.store.folder.is_local:
            check_space(Path(self.store.folder.place).parent, round(before), "tiles and parts of files")

    def check_version(self) -> None:
        """Raise if this process, a worker, would write other bytes than the command."""
        if self.store.run != digest(self.manifest):
            raise RunError("this worker has another version of sat-intervals: install the same for all")
        wanted = self.inputs.get("weights", {}).get("onnxruntime")
        if wanted and (here := version("onnxruntime")) != wanted:
            raise RunError(f"onnxruntime is {here} here, but the run has {wanted}: install the same for all workers")

    def write_statistics(self, statistics: PairStatistics) -> None:
        """Keep mean and standard deviation of both images for all tiles."""
        self.store.write(ONCE, _STATISTICS, **statistics.report())

    def has_statistics(self) -> bool:
        """Return whether the statistics of `write_statistics` are there, or the run needs none."""
        return not self.config.cost.needs_statistics or self.store.meta(ONCE, _STATISTICS) is not None

    def statistics(self) -> PairStatistics | None:
        """Return mean and standard deviation of both images, None if the run needs none."""
        if not self.config.cost.needs_statistics:
            return None
        kept = self.store.meta(ONCE, _STATISTICS)
        if kept is None:
            raise DamagedTilesError(
                f"the image statistics in {self.store.folder} are missing: rerun the same command: it resumes"
            )
        return PairStatistics.of_report({side: kept[side] for side in ("left", "right")})

    def ranges(self) -> LocalRanges | None:
        """Return the local search ranges, None without them."""
        if not self.config.disparity.is_local or self.local is not None:
            return self.local
        kept = self.store.meta(ONCE, _RANGE, origin_of(self.inputs)) or {}
        if kept.get("ranges") is None or digest(kept["ranges"]) != self.ranges_digest:
            raise DamagedTilesError(
                f"the local search ranges in {self.store.folder} are missing: rerun the same command: it resumes"
            )
        return LocalRanges.of_report(kept["ranges"])

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what workers read from the store, see `ranges`."""
        return self.__dict__ | {"local": None, "survey": None}

    def waiting(self) -> list[Tile]:
        """Return the tiles that are not done."""
        done = self.store.names(TILES)
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
    find: Finds | None = None,
) -> Job:
    """Check all that can be checked before tiles are matched; ``find`` finds what no earlier run has found.

    Without ``find`` rows are not looked at.
    """
    config, out = resolved(load_config(config)), Path(out)
    if isinstance(config.cost, Volume) and config.cost.name is None:
        raise SatIntervalsError("cost.method volume needs the function that makes volumes: give match_pair volume_of")
    requested = config.disparity.model_dump(mode="json")
    left, right = checked_pair(left, right, config)
    images = left, right
    region = checked_region(left, window)
    if not config.disparity.is_auto:
        check_tiles(fitted_to_jobs(config), region)
    check_folder(out, overwrite=overwrite)
    before: dict[str, Any] = {}  # manifest or report of an earlier run
    with suppress(StoreError):
        before = read_manifest(home_of(out)) or read_report(out) or {}
    inputs = describe_inputs(left, right, config, identities(before.get("inputs", {})))
    known = _known(out, before, inputs)
    config, found, local = searched(config, left, lambda: _found(known, find, *images))
    checked_pair(left, right, config)
    config = fitted_to_jobs(config)
    check_tiles(config, region)
    survey = _survey(known, find, left, right, config, region)
    missed = survey.missed(lambda: _found({}, find, *images)) if survey and find and not (found or window) else ""
    right = replace(right, rows=_rows_taken(survey, config, left, right, missed))
    read = [*identities(inputs), *(files_of(config.disparity.grid) if config.disparity.grid else ())]
    ranges = digest(local.report()) if local else None
    run = digest(_manifest(config, inputs, region, ranges, right.rows))
    store = config.cluster.store
    folder = folder_at(f"{folder_at(store)}/{'-'.join(filter(None, (pair, run)))}" if store else home_of(out))
    kept = Store(folder, Grid(region, config.tiles.size), run)
    check_not_replaced(read, [out / name for name in OUTPUTS], [home_of(out)])
    return Job(left, right, config, kept, out, inputs, requested, found, survey, ranges, local, missed, overwrite)


def _known(out: Path, before: Mapping[str, Any], inputs: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what an earlier run of the same images has found: ``found`` and ``survey``."""
    if PLACE in before:
        store = Store(place_of(home_of(out), before), _NO_TILES, "")
        return store.meta(ONCE, _RANGE, origin_of(inputs)) or {}
    if before.get("origin") == origin_of(inputs):
        return {"found": before["search"], "survey": before["survey"]}
    return {}


def _found(known: Mapping[str, Any], find: Finds | None, left: Image, right: Image) -> Found:
    if known.get("found"):
        return Found.of_report(known["found"])
    if find is None:
        raise SatIntervalsError("the search range is auto: give it as numbers")
    return find.search_range(left, right)


def _survey(
    known: Mapping[str, Any], find: Finds | None, left: Image, right: Image, config: Config, region: Window
) -> Survey | None:
    search = config.disparity.minimum, config.disparity.maximum
    if known.get("survey"):
        survey = Survey.of_report(known["survey"])
        if (survey.region, survey.search) == (region, search):
            return survey
    return find.survey(left, right, region, search) if find else None


def _rows_taken(survey: Survey | None, config: Config, left: Image, right: Image, missed: str) -> RowOffsets | None:
    try:
        return survey.taken(config.rows, missed) if survey else None
    except SatIntervalsError as error:
        raise SatIntervalsError(f"{left.path} and {right.path}: {error}") from None


def origin_of(inputs: Mapping[str, Any]) -> str:
    """Return a digest of all that decides which search range is found."""
    images = {side: inputs[side] for side in ("left", "right")}
    return digest({"version": _version(), "kernels": FINGERPRINT, "inputs": images})


def remove_tiles(out: Path) -> None:
    """Delete the tiles of the run in a folder, wherever they are, the manifest last."""
    home = home_of(out)
    with suppress(StoreError):
        if manifest := read_manifest(home):
            Store(place_of(home, manifest), _NO_TILES, "").remove()
    Store(folder_at(home), _NO_TILES, "").remove()
    (home / MANIFEST).unlink(missing_ok=True)
    folder_at(home).remove_if_empty()


_version = cache(lambda: version("sat-intervals"))  # reading it takes 2 ms, and each tile compares manifests


def _manifest(
    config: Config, inputs: Mapping[str, Any], region: Window, ranges: str | None, rows: RowOffsets | None
) -> dict[str, Any]:
    """Return all that decides the bytes of a tile; of a calibration only its levels."""
    settings = config.model_dump(mode="json", exclude=_NOT_OF_TILES)
    levels = config.cuts
    if levels is not None:
        settings["interval"] = {
            "high": levels.high,
            "low": levels.low,
            "steps": config.bound_steps,
            "cut": config.fit_cut,
        }
    return {
        **({"local_ranges": ranges} if ranges else {}),
        **({"rows": asdict(rows)} if rows else {}),
        "version": _version(),
        "kernels": FINGERPRINT,
        "layout": LAYOUT,
        "settings": settings,
        "inputs": inputs,
        "region": asdict(region),
    }
