"""A pair made ready to be matched: images opened and checked, its folder, its tiles, its store."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sat_intervals.config import Config, Mccnn, load_config
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels import FINGERPRINT
from sat_intervals.machine import usable_cores
from sat_intervals.match.mccnn import load_network, weights_file
from sat_intervals.match.memory import check_memory, fitted, volume_bytes
from sat_intervals.raster import RUN_FILES, Image, check_pair, check_space, open_image
from sat_intervals.raster.identity import check_not_replaced, check_unchanged
from sat_intervals.run.cluster import parse_memory
from sat_intervals.run.inputs import check_weights, describe_inputs
from sat_intervals.run.output import OUTPUTS, check_output, holds_run, is_complete
from sat_intervals.store.folder import folder_at
from sat_intervals.store.manifest import digest
from sat_intervals.store.tiles import LAYOUT, Store, finished_run, inputs_before
from sat_intervals.tiling import Grid, Tile, Window

# What no tile knows of the settings: a preset is known by what it set.
_AFTER_THE_TILES = {"preset", "median", "regularization", "products", "cluster"}


@dataclass(frozen=True)
class Job:
    """What a worker needs to match any tile of a pair, and what comes after.

    Attributes
    ----------
    left, right
        The images.
    config
        Settings.
    store
        Where tiles go; its grid says which there are.
    out
        Folder of the run.
    inputs
        What run.json says of the images, and of the weights of MC-CNN.
    files
        What `identity` says of each file that the images are read from, by the name it is opened by.
    """

    left: Image
    right: Image
    config: Config
    store: Store
    out: Path
    inputs: dict[str, Any]
    files: dict[str, dict[str, Any]]

    @property
    def manifest(self) -> dict[str, Any]:
        """All that decides the bytes of a tile."""
        return _manifest(self.config, self.inputs, self.store.grid.region)

    @property
    def name(self) -> str:
        """A name that this run shares with no other: all that decides the bytes of its files."""
        return digest(self.manifest | {"all": self.config.model_dump(mode="json", exclude={"cluster", "preset"})})

    def is_finished(self) -> bool:
        """Whether the folder holds the files of this very run, which died before it removed its tiles."""
        noted = finished_run(self.store.home)
        return is_complete(self.out) and noted is not None and noted[0] == self.name

    def begin(self, *, overwrite: bool = False) -> None:
        """Open the store for what decides the bytes of a tile; to be called while its folder is locked.

        With ``overwrite`` the files of the run before stay until this one replaces them; it can be resumed without.
        """
        if not overwrite and is_complete(self.out):  # of this run or of one that ended before the lock was free
            raise holds_run(self.out, OUTPUTS)
        check_output(self.out, overwrite)
        self.store.open(self.manifest, overwrite=overwrite)

    def check_inputs(self) -> None:
        """Hold that all inputs are those of the run still, the weights those that this process finds.

        Raises
        ------
        ChangedInputError
            With the first that is not.
        """
        check_unchanged(self.files)
        if isinstance(self.config.cost, Mccnn):
            check_weights(self.config.cost, self.inputs["weights"])

    def waiting(self) -> list[Tile]:
        """The tiles that are not done."""
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
) -> Job:
    """Check all that can be checked before a pixel is read; parameters as of `match_pair`.

    ``pair`` keeps pairs of a batch apart that are the same in all else, where their tiles lie elsewhere.
    """
    config, out = fitted_to_jobs(load_config(config)), Path(out)
    left, right = checked_pair(left, right, config)
    region = checked_region(left, window)
    check_tiles(config, region)
    check_output(out, overwrite)
    check_space(out, RUN_FILES, region.height, region.width)
    home, elsewhere = out / "tiles", None
    inputs, files = describe_inputs(left, right, config, inputs_before(home, config.cluster.store))
    read = [*files, inputs["weights"]["path"]] if "weights" in inputs else files
    if config.cluster.store and folder_at(config.cluster.store) != folder_at(home):
        name = "-".join(filter(None, (pair, digest(_manifest(config, inputs, region)))))
        elsewhere = str(folder_at(config.cluster.store).inside(name))
    # of the runs in a local store each has a folder whose name ends with a digest
    stores = Path(elsewhere).parent.glob("*" + 32 * "[0-9a-f]") if elsewhere and "://" not in elsewhere else ()
    check_not_replaced(read, [out / name for name in OUTPUTS], [home, *stores])
    grid = Grid(region, config.tiles.size)
    store = Store(home, grid, config.disparity.count, config.largest_ambiguity, elsewhere)
    return Job(left, right, config, store, out, inputs, files)


def _manifest(config: Config, inputs: Mapping[str, Any], region: Window) -> dict[str, Any]:
    """All that decides the bytes of a tile."""
    return {
        "version": version("sat-intervals"),
        "kernels": FINGERPRINT,
        "layout": LAYOUT,
        "settings": config.model_dump(mode="json", exclude=_AFTER_THE_TILES),
        "inputs": inputs,
        "region": asdict(region),
    }


def fitted_to_jobs(config: Config) -> Config:
    """The settings with tiles that fit in the memory that they give a job of a batch system.

    Raises
    ------
    ConfigError
        As of `fitted` and `parse_memory`.
    """
    if config.cluster.memory is None:
        return config
    # dask kills a worker that takes 95 % of its memory
    return fitted(config, 9 * parse_memory(config.cluster.memory) // 10, config.cluster.cores)


def checked_pair(left: str | Path | Image, right: str | Path | Image, config: Config) -> tuple[Image, Image]:
    """Open the images of a pair and check that they can be matched."""
    left, right = (image if isinstance(image, Image) else open_image(image) for image in (left, right))
    check_pair(left, right, config.disparity.count)
    config.disparity.check_images(left.path, left.width, right.path, right.width)
    if isinstance(config.cost, Mccnn):
        load_network(weights_file(config.cost.weights))
    return left, right


def checked_region(left: Image, window: Window | None) -> Window:
    """What is matched of the left image: the window that is given, or all of it."""
    whole = Window(0, 0, left.height, left.width)
    if window is None:
        return whole
    if window.height < 1 or window.width < 1 or window.clipped(whole) != window:
        raise SatIntervalsError(
            f"window at row {window.row}, column {window.column}, {window.height} x {window.width} pixels: "
            f"must lie inside {left.path}, {left.height} x {left.width} pixels"
        )
    return window


def check_tiles(config: Config, region: Window) -> None:
    """Refuse tiles that this process cannot hold; what jobs and the workers of a scheduler have is theirs to know."""
    if config.cluster.kind not in ("threads", "processes"):
        return
    height, width = (min(config.tiles.size, side) for side in (region.height, region.width))
    workers = min(config.cluster.workers or usable_cores(), len(Grid(region, config.tiles.size)))
    check_memory(
        workers * volume_bytes(height, width, config),
        f"tiles of {height} x {width} pixels x {config.disparity.count} disparities, {workers} at once,",
        "choose a smaller --tile-size or fewer --workers",
    )
