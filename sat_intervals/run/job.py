"""Prepare a pair for matching: images, search range, inputs, tiles, and the state of its folder."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sat_intervals.config import Config, HeightCalibration, load_config, resolved
from sat_intervals.errors import RunError
from sat_intervals.kernels import FINGERPRINT
from sat_intervals.match.ground import GroundViews, ground_of, report_of_ground
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import VolumeOf
from sat_intervals.match.schedule import blocks_of
from sat_intervals.prepare.pair import Each, FilePair, here
from sat_intervals.prepare.prepared import Prepared, prepare
from sat_intervals.products import plain
from sat_intervals.raster import Image, check_space, files_of, path_of
from sat_intervals.raster.completion import Completion
from sat_intervals.raster.identity import absolute_in, check_not_replaced, identities, relative_in
from sat_intervals.run.checks import check_tiles, checked_pair, checked_region, disk_bytes, fitted_to_jobs
from sat_intervals.run.inputs import describe_inputs
from sat_intervals.run.state import check_folder, next_step, outputs_of, read_report, with_store
from sat_intervals.store.arrays import DamagedFileError, numbered
from sat_intervals.store.folder import folder_at
from sat_intervals.store.manifest import MANIFEST, PLACE, StoreError, digest, place_of, read_manifest, write_manifest
from sat_intervals.store.tiles import LAYOUT, NO_TILES, ONCE, PARTS, TILES, DamagedTilesError, Store, home_of
from sat_intervals.tiling import Grid, Tile, Window

# Settings without effect on tiles; those of the preset itself are listed one by one.
_NOT_OF_TILES = {"preset", "rows", "median", "regularization", "products", "cluster"}
_RANGE, _GROUND = "range", "ground"
_REMOTE = "check URL and credentials, and pip install the package of its file system ('sat-intervals[remote]' for S3)"


@dataclass(frozen=True)
class Swept:
    """What a sweep of many images has instead of a pair.

    images: by the names of their records.
    asked: digest of all that its geometry was found from.
    level: what its heights are above, in words; ``calibration``: margins that move their bounds; ``completion``: what
        is done to the measured surface.
    report: shifts and other figures, for ``run.json``.
    """

    images: dict[str, Image]
    asked: str
    level: str
    report: dict[str, Any]
    calibration: HeightCalibration | None = None
    completion: Completion | None = None


@dataclass(frozen=True)
class Job:
    """All that is needed to match any tile of a pair and to assemble its files; picklable.

    ``prepared`` is what was found of the pair; workers read the local ranges from the store. ``manifest`` is all that
    decides the bytes of a tile, and where the tiles are. ``requested`` is the section ``disparity`` as given. With
    ``overwrite``, files and another run in ``out`` may be replaced. `calibrate` makes no files of its tiles:
    ``has_files`` is False. ``volume_of`` makes the volumes of another matcher; its name is in the settings. ``swept``:
    what a sweep of many images has instead of a pair; its ``left`` is the grid of cells.
    """

    prepared: Prepared[FilePair]
    store: Store
    out: Path
    manifest: dict[str, Any]
    requested: dict[str, Any]
    overwrite: bool = False
    has_files: bool = True
    volume_of: VolumeOf | None = None
    swept: Swept | None = None

    @property
    def left(self) -> Image:
        """Return the left image."""
        return self.prepared.pair.left

    @property
    def right(self) -> Image:
        """Return the right image, with the row offsets that are taken out of it."""
        return self.prepared.pair.right

    @property
    def images(self) -> dict[str, Image]:
        """Return the images that tiles are matched from, by the names of their records."""
        return self.swept.images if self.swept else {"left": self.left, "right": self.right}

    @property
    def config(self) -> Config:
        """Return the settings, with the search range as numbers."""
        return self.prepared.config

    @property
    def inputs(self) -> dict[str, Any]:
        """Return the inputs as `describe_inputs` does, with paths inside ``out`` relative to it."""
        return dict(self.manifest["inputs"])

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
        return digest(self.manifest | {"all": self.settings, "asked": self.swept and self.swept.report["request"]})

    @property
    def settings(self) -> dict[str, Any]:
        """Return the settings that decide the bytes of the files."""
        return self.config.model_dump(mode="json", exclude={"cluster", "preset"})

    def begin(self) -> bool:
        """Open the store and return True; False if the run is complete. Call it while the folder is locked."""
        names = outputs_of(self.config)
        step = next_step(self.out, self.manifest, self.name, self.settings, overwrite=self.overwrite, names=names)
        if step == "complete":
            return False
        if step == "start anew":
            remove_tiles(self.out)
        try:
            self.store.write(ONCE, "begun")  # fails at once where nothing can be written
            if step != "resume":
                write_manifest(home_of(self.out), self.manifest)
            ranges = self.prepared.ranges and self.prepared.ranges.report()
            self.store.write(ONCE, _RANGE, of=origin_of(self.inputs), ranges=ranges, **self.prepared.known())
            if self.prepared.ground and (swept := self.swept):
                figures, arrays = report_of_ground(self.prepared.ground)
                self.store.write(ONCE, _GROUND, numbered(arrays), of=swept.asked, figures=figures, report=swept.report)
        except OSError as error:
            remedy = "make room, check its rights or choose another folder" if self.store.folder.is_local else _REMOTE
            raise StoreError(f"{self.store.folder} cannot be used: {error.strerror or error}: {remedy}") from error
        self._check_space()
        return True

    def _check_space(self) -> None:
        """Raise if disks have no room for what a run has yet to write."""
        ranges, images = self.prepared.ranges, self.images.values()
        tiles, parts, final = disk_bytes(self.store.grid, self.config, images, ranges)
        share = len(self.waiting()) / len(self.store.grid)
        before = share * tiles + max(0, self.has_files * parts - sum(self.store.folder.sizes(PARTS).values()))
        final *= self.has_files
        if self.is_home:
            check_space(self.out, round(before + final), "tiles, files and their parts")
            return
        check_space(self.out, final, "files")
        if self.store.folder.is_local:
            check_space(Path(self.store.folder.place).parent, round(before), "tiles and parts of files")

    def check_version(self) -> None:
        """Raise if this process, a worker, would write other bytes than the command."""
        if any(self.manifest[name] != value for name, value in _made_by().items()):
            raise RunError("this worker has another version of sat-intervals: install the same for all")
        for package in self.config.cost.packages:
            wanted = next(one[package] for one in self.inputs.values() if package in one)
            if (here := version(package)) != wanted:
                raise RunError(f"{package} is {here} here, but the run has {wanted}: install the same for all workers")

    def ranges(self) -> LocalRanges | None:
        """Return the local search ranges, None without them."""
        if self.prepared.ranges or "local_ranges" not in self.manifest:
            return self.prepared.ranges
        kept = (self.store.meta(ONCE, _RANGE, origin_of(self.inputs)) or {}).get("ranges")
        if kept is None or digest(kept) != self.manifest["local_ranges"]:
            where = f"the local search ranges in {self.store.folder}"
            raise DamagedTilesError(f"{where} are missing: rerun the same command: it resumes")
        return LocalRanges.of_report(kept)

    def ground(self) -> GroundViews | None:
        """Return where many images show the ground; None of a pair."""
        if self.prepared.ground or self.swept is None:
            return self.prepared.ground
        try:
            return _read_ground(self.store, self.swept.asked)[0]
        except DamagedFileError as error:
            where = f"the geometry in {self.store.folder}"
            raise DamagedTilesError(f"{where} is missing: rerun the same command: it resumes") from error

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what workers read from the store, see `ranges` and `ground`, evidence, and areas."""
        prepared = replace(self.prepared, ranges=None, search=None, survey=None, ground=None)
        return self.__dict__ | {"prepared": prepared, "swept": self.swept and replace(self.swept, completion=None)}

    def waiting(self) -> list[Tile]:
        """Return the tiles that are not done."""
        done = self.store.names(TILES)
        return [tile for tile in self.store.grid if tile.name not in done]


def open_job(
    left: str | Path | Image,
    right: str | Path | Image,
    out: str | Path,
    config: Any,
    *,
    window: Window | None = None,
    overwrite: bool = False,
    pair: str = "",
    each: Each = here,
) -> Job:
    """Check all that can be checked before tiles are matched, and prepare the pair."""
    config, out = resolved(load_config(config)), path_of(out)
    requested = config.disparity.model_dump(mode="json")
    images = checked_pair(left, right, config)
    region = checked_region(images[0], window)
    if not config.disparity.is_auto:
        check_tiles(fitted_to_jobs(config), region)
    check_folder(out, overwrite=overwrite)
    before: dict[str, Any] = {}  # manifest or report of an earlier run
    with suppress(StoreError):
        before = read_manifest(home_of(out)) or read_report(out) or {}
    files = identities(absolute_in(out, before.get("inputs", {})))
    inputs = describe_inputs(dict(zip(("left", "right"), images, strict=True)), config, files)
    known = _known(out, before, relative_in(out, inputs))
    prepared = prepare(FilePair(*images), config, each, region=window, known=known)
    return job_of(prepared, out, inputs, requested, region, overwrite=overwrite, pair=pair)


def job_of(
    prepared: Prepared[FilePair],
    out: Path,
    inputs: dict[str, Any],
    requested: dict[str, Any],
    region: Window,
    *,
    overwrite: bool = False,
    pair: str = "",
    swept: Swept | None = None,
) -> Job:
    """Make the job of a prepared pair in a folder; its tiles are named by ``pair`` where several share a store."""
    config = fitted_to_jobs(prepared.config.model_copy(update={"cluster": with_store(prepared.config.cluster, out)}))
    check_tiles(config, region, prepared.ranges)
    prepared = replace(prepared, config=config)
    read = [*identities(inputs), *(files_of(config.disparity.grid) if config.disparity.grid else ())]
    manifest = _manifest(prepared, relative_in(out, inputs), region)
    run = digest(manifest)
    store = config.cluster.store
    manifest[PLACE] = f"{folder_at(store)}/{'-'.join(filter(None, (pair, run)))}" if store else None
    check_not_replaced(read, [out / name for name in outputs_of(config)], [home_of(out)])
    kept = Store(place_of(home_of(out), manifest), Grid(region, config.tiles.size), run)
    return Job(prepared, kept, out, manifest, requested, overwrite, swept=swept)


@lru_cache(1)  # of a large grid it is tens of MB
def _read_ground(store: Store, asked: str) -> tuple[GroundViews, dict[str, Any]]:
    with store.opened(ONCE, _GROUND, asked) as archive:
        arrays = [archive[name].copy() for name in archive.names()]
        return ground_of(archive.meta["figures"], arrays), dict(archive.meta["report"])


def kept_ground(out: Path, asked: str) -> tuple[GroundViews, dict[str, Any]] | None:
    """Return what an earlier start of the same sweep in a folder has found, and what it noted of it; None without."""
    with suppress(StoreError, DamagedFileError):
        if manifest := read_manifest(home_of(out)):
            return _read_ground(Store(place_of(home_of(out), manifest), NO_TILES, ""), asked)
    return None


def _known(out: Path, before: Mapping[str, Any], inputs: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what an earlier run of the same images has found, see `Prepared.known`."""
    if PLACE in before:
        return Store(place_of(home_of(out), before), NO_TILES, "").meta(ONCE, _RANGE, origin_of(inputs)) or {}
    if before.get("origin") == origin_of(inputs):
        statistics = before["normalization"] and {"rows": before["rows"], **before["normalization"]}
        return {"found": before["search"], "survey": before["survey"], "statistics": statistics}
    return {}


def origin_of(inputs: Mapping[str, Any]) -> str:
    """Return a digest of all that decides which search range is found."""
    images = {name: inputs[name] for name in inputs if name in ("left", "right") or name.startswith("image_")}
    return digest({"version": _version(), "kernels": FINGERPRINT, "inputs": images})


def remove_tiles(out: Path) -> None:
    """Delete the tiles of the run in a folder, wherever they are, the manifest last."""
    home = home_of(out)
    with suppress(StoreError):
        if manifest := read_manifest(home):
            Store(place_of(home, manifest), NO_TILES, "").remove()
    Store(folder_at(home), NO_TILES, "").remove()
    (home / MANIFEST).unlink(missing_ok=True)
    folder_at(home).remove_if_empty()


_version = cache(lambda: version("sat-intervals"))  # reading it takes 2 ms, and each tile asks for it


def _made_by() -> dict[str, Any]:
    """Return what decides the bytes of a tile in this process."""
    return {"version": _version(), "kernels": FINGERPRINT, "layout": LAYOUT}


def _identity(ground: GroundViews) -> dict[str, Any]:
    figures, arrays = report_of_ground(ground)
    return dict(plain(figures)) | {"places": sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()}


def _manifest(prepared: Prepared[FilePair], inputs: Mapping[str, Any], region: Window) -> dict[str, Any]:
    """Return all that decides the bytes of a tile; of a calibration only its levels."""
    config = prepared.config
    settings = config.model_dump(mode="json", exclude=_NOT_OF_TILES)
    if levels := config.cuts:
        cuts = {"high": levels.high, "edge": levels.edge, "low": levels.low}
        settings["interval"] = cuts | {"steps": config.bound_steps, "cut": config.fit_cut}
    return {
        **({"local_ranges": digest(prepared.ranges.report())} if prepared.ranges else {}),
        **({"rows": asdict(prepared.rows)} if prepared.rows else {}),
        **({"ground": _identity(prepared.ground)} if prepared.ground else {}),
        **_made_by(),
        "settings": settings,
        "inputs": inputs,
        "region": asdict(region),
    }
