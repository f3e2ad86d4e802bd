"""A pair made ready to be matched: images opened and checked, its folder, its tiles, its store."""

import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Config, Mccnn, load_config
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels import FINGERPRINT
from sat_intervals.machine import usable_cores
from sat_intervals.match.mccnn import load_network, weights_file
from sat_intervals.match.memory import check_memory, fitted, volume_bytes
from sat_intervals.match.normalization import ImageStatistics, PairStatistics
from sat_intervals.match.patch import match_patch
from sat_intervals.match.postprocess import ConfidenceScale, RawRows, postprocess_strips
from sat_intervals.raster import RUN_FILES, Image, check_pair, check_space, open_image, other_files
from sat_intervals.raster.identity import ChangedInputError, check_not_replaced, check_unchanged, identity
from sat_intervals.run.cluster import parse_memory
from sat_intervals.store.folder import folder_at
from sat_intervals.store.manifest import differences, digest
from sat_intervals.store.tiles import LAYOUT, Store, finished_run, has_begun, inputs_before, is_replacing
from sat_intervals.tiling import Grid, Tile, Window

# What no tile knows of the settings: a preset is known by what it set.
_AFTER_THE_TILES = {"preset", "median", "regularization", "products", "cluster"}
OUTPUTS = ("intervals.tif", "validity.tif", "run.json")


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
            raise _holds_run(self.out, OUTPUTS)
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
            here, wanted = weights_identity(self.config.cost), self.inputs["weights"]
            for key in ("sha256", "onnxruntime"):
                if here[key] != wanted[key]:
                    raise ChangedInputError(
                        f"{here['path']} differs in {key} from {wanted['path']} of the run: it was replaced, or this "
                        "worker has another"
                    )

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
    inputs, files = _inputs(left, right, config, inputs_before(home, config.cluster.store))
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


def changes_since(report: Mapping[str, Any], left: Image, right: Image, config: Config) -> list[str]:
    """In what the run of a ``run.json`` differs from one of whole images with settings, a line each.

    Versions do not count, and neither does where tiles were matched.
    """
    config = fitted_to_jobs(config)
    before = {
        "settings": load_config(report["settings"]).model_dump(mode="json", exclude={"cluster", "preset"}),
        "inputs": report["inputs"],
        "region": report["tiles"]["region"],
    }
    now = {
        "settings": config.model_dump(mode="json", exclude={"cluster", "preset"}),
        "inputs": _inputs(left, right, config, report["inputs"])[0],
        "region": asdict(checked_region(left, None)),
    }
    for one in (before, now):
        one["inputs"].get("weights", {}).pop("onnxruntime", None)
    return list(differences(before, json.loads(json.dumps(now))))


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
    check_pair(left, right, config.disparity.minimum, config.disparity.maximum)
    if isinstance(config.cost, Mccnn):
        load_network(weights_file(config.cost.weights))
    return left, right


def weights_identity(cost: Mccnn) -> dict[str, Any]:
    """What run.json and the manifest say of the weights, and of what runs them."""
    return {**identity(str(weights_file(cost.weights))), "onnxruntime": version("onnxruntime")}


def check_output(out: Path, overwrite: bool) -> None:
    """Make the folder of a run, or tell why it cannot be used."""
    if os.path.lexists(out) and not out.is_dir():
        raise SatIntervalsError(f"{out} is no folder: choose another")
    try:
        there = [name for name in OUTPUTS if (out / name).exists()]
        # run.json is the last: without it, but with tiles, a run was killed between the names of its files
        home = out / "tiles"
        is_unfinished = is_replacing(home) or finished_run(home) is not None
        is_under_way = is_unfinished or ("run.json" not in there and has_begun(home))
        if there and not overwrite and not is_under_way:
            raise _holds_run(out, there)
        if (out / "tiles").is_symlink():
            raise SatIntervalsError(f"{out / 'tiles'} is a symbolic link: name the place of the tiles with --store")
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise SatIntervalsError(f"{out} cannot be written: {error.strerror}: choose another folder") from error


def _holds_run(out: Path, there: Sequence[str]) -> SatIntervalsError:
    return SatIntervalsError(f"{out} already holds a run ({', '.join(there)}): choose another folder or --overwrite")


def is_complete(out: Path) -> bool:
    """Whether a folder holds all files of a run, and none has begun that is to replace them."""
    return all((out / name).exists() for name in OUTPUTS) and not is_replacing(out / "tiles")


def stamps(out: Path) -> list[str]:
    """Sizes and times of the files of a run, which a copy of the folder that keeps times has too."""
    found = [(out / name).stat() for name in OUTPUTS]
    return [f"{status.st_size:x}-{status.st_mtime_ns:x}" for status in found]


def check_as_published(out: Path) -> None:
    """Hold that a complete run whose tiles are still there has the files that it published, before the tiles go.

    Raises
    ------
    SatIntervalsError
        With the first that is another.
    """
    _, noted = finished_run(out / "tiles") or ("", [])
    for name, before, now in zip(OUTPUTS, noted, stamps(out), strict=False):
        if now != before:
            raise SatIntervalsError(
                f"{out / name} was changed after the run, whose tiles are still there: delete it, and the same command "
                "makes it again, or start afresh with --overwrite"
            )


def compile_kernels(config: Config) -> None:
    """Match a few random pixels, so that every kernel is compiled, or read from numba's cache, once and first."""
    random = np.random.default_rng(0)

    def read(window: Window) -> tuple[np.ndarray, np.ndarray]:
        pixels = random.random((window.height, window.width), np.float32)
        return pixels, np.zeros(pixels.shape, np.uint8)

    spot = Window(0, 0, 4, 4)
    statistics = PairStatistics(ImageStatistics(0.5, 0.3), ImageStatistics(0.5, 0.3))
    patch = match_patch(read, read, spot, spot, spot, config, statistics)
    raw = patch.raw
    rows = RawRows(raw.winner, raw.lower, raw.upper, raw.disparity, raw.ambiguity, raw.validity, patch.right.winner)
    list(postprocess_strips([rows], ConfidenceScale(0.0, 1.0), config))


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


def _inputs(
    left: Image, right: Image, config: Config, before: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """What run.json and the manifest say of the inputs, and of each file of the images by its name.

    What they said before saves hashing files again.
    """
    known, files = _known(before), {}

    def told(name: str) -> dict[str, Any]:
        if name not in files:
            files[name] = identity(name, known)
        return files[name]

    inputs = {"left": _described(left, told), "right": _described(right, told)}
    if isinstance(config.cost, Mccnn):
        inputs["weights"] = weights_identity(config.cost)
    return inputs, files


def _known(inputs: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What a manifest says of the files of its inputs, by path."""
    ways = [one for both in inputs.values() for one in (both, both.get("mask")) if one]
    described = [file for one in ways for file in (one, *one.get("files", ()))]
    return {file["path"]: file for file in described if "sha256" in file}


def _described(image: Image, told: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """What run.json and the manifest say of an input."""
    crs = image.georeferencing.crs
    return {
        **_with_others(image.path, told),
        "height": image.height,
        "width": image.width,
        "band": image.band,
        "dtype": image.dtype,
        "nodata": None if image.nodata is None else repr(image.nodata),
        "crs": crs.to_string() if crs else None,
        "use_mask": image.use_mask,
        "alpha": image.alpha,
        "mask": _with_others(image.mask, told) if image.mask else None,
    }


def _with_others(name: str, told: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """What is told of a raster, and of the other files it is read from."""
    return {**told(name), "files": [told(file) for file in other_files(name)]}
