"""Markers and fixtures of all tests."""

import gc
import os
import subprocess
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
from helpers import PLACE, VRT, wait_until, write_pair
from sweeps import Sweep
from sweeps import swept as make_sweep

from sat_intervals import load_config, match_pair
from sat_intervals.demo import Scene, make_scene
from sat_intervals.kernels import registration
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.raster import write_layer
from sat_intervals.workflows.demo import write_views
from sat_intervals.workflows.surface import surface

pytest_plugins = ["services.browser", "services.s3", "services.slurm", "services.web"]

# No deadline for an example: it would make tests fail on a busy machine.
hypothesis.settings.register_profile("project", deadline=None)
hypothesis.settings.load_profile("project")

# A test that asks for one of these fixtures has this marker.
MARKERS = dict.fromkeys(("browser", "bucket", "disk", "slurm", "web_server"), "process") | {"shared_data": "peer"}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--skip-nothing", action="store_true", help="a test that would be skipped fails")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        for fixture in MARKERS.keys() & item.fixturenames:
            item.add_marker(MARKERS[fixture])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip tests marked ``peer("module", ...)`` if one of the modules is not installed."""
    for name in [name for marker in item.iter_markers("peer") for name in marker.args if find_spec(name) is None]:
        pytest.skip(f"{name} is not installed")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    report = yield
    if report.skipped and item.config.getoption("--skip-nothing"):
        report.outcome = "failed"
    return report


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """What was imported is there to stay: the garbage collector need not look through it again and again."""
    gc.freeze()


# Settings that need different machine code, those that take longest to compile first: each worker takes the next.
LEAST = {"cross_check": None, "median": None, "regularization": None}
SEARCH, SGM = {"minimum": 0, "maximum": 9}, {"p1": 8, "p2": 32}
VARIANTS = (
    {"preset": "satellite"},
    {"preset": "paper", "disparity": SEARCH | {"local": True}} | LEAST,
    {"preset": "paper", "cost": {"method": "volume", "name": "kernels", "span": 24}, "sgm": SGM} | LEAST,
)


@pytest.fixture(scope="session", autouse=True)
def kernels(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Parallel workers share the compilation of kernels before their first test, so that none is compiled twice."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    shared = tmp_path_factory.getbasetemp().parent
    for number, settings in enumerate(VARIANTS):
        try:
            (shared / f"kernels{number}").mkdir()
        except FileExistsError:  # another worker compiles these
            continue
        try:
            compile_kernels(load_config({"disparity": SEARCH} | settings))
        finally:
            (shared / f"kernels{number}" / "done").touch()
    wait_until(lambda: len(list(shared.glob("kernels*/done"))) == len(VARIANTS), "kernels", seconds=600)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real pairs."""
    folder = Path(os.environ.get("SAT_INTERVALS_SHARED", "../shared")) / "data"
    if not folder.is_dir():
        pytest.skip(f"no real pairs in {folder}: SAT_INTERVALS_SHARED names the folder that holds data/")
    return folder


@pytest.fixture(scope="session")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with left.tif, right.tif, settings.yaml for 7 x 8 tiles, and an undisturbed run of one tile."""
    folder = tmp_path_factory.mktemp("pair")
    settings = write_pair(folder, make_scene(400, 500, seed=3), tiles={"size": 64})
    whole = settings | {"tiles": {"size": 512}}
    match_pair(folder / "left.tif", folder / "right.tif", folder / "undisturbed", whole)
    return folder


@pytest.fixture(scope="session")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished sweep of three images, which are beside it: 1.tif, 2.tif, 3.tif."""
    folder = tmp_path_factory.mktemp("swept")
    images, _ = write_views(folder, 200, 200, 3)
    surface(images, folder / "out", resolution=0.5)
    return folder / "out"


@pytest.fixture(scope="session")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    """A surface of five images, made in one tile."""
    return make_sweep(tmp_path_factory.mktemp("sweep"), config={"preset": "many", "tiles": {"size": 256}})


@pytest.fixture(scope="session")
def small_scene() -> Scene:
    return make_scene(80, 100, seed=2)


@pytest.fixture
def small_pair(small_scene: Scene, tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    """A folder with left.tif, right.tif, mask.tif, mask.vrt of it, and other.tif; and settings of four tiles."""
    write_layer(tmp_path / "other.tif", small_scene.right[::-1].copy(), 0, PLACE)
    write_layer(tmp_path / "mask.tif", np.zeros(small_scene.left.shape, np.uint8), 0, PLACE)
    (tmp_path / "mask.vrt").write_text(VRT)
    tiles, cluster = {"size": 64, "overlap": 20}, {"workers": 1, "retries": 0}
    disparity = {"minimum": -18, "maximum": 40}
    return tmp_path, write_pair(tmp_path, small_scene, disparity=disparity, tiles=tiles, cluster=cluster)


@pytest.fixture
def thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search for the shift of a surface takes few points and is near: it takes a hundredth of the time."""
    monkeypatch.setattr(registration, "_SEARCHED", 2000)
    monkeypatch.setattr(registration, "REACH", 16)


@pytest.fixture
def unrendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made and not rendered, which takes most of their time: for tests that look at what is drawn."""
    from matplotlib.figure import Figure

    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **options: path.write_bytes(b"drawn"))


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """A function that mounts a disk of a given number of bytes, or resizes it."""
    place = tmp_path / "disk"
    place.mkdir()

    def of_size(count: int) -> Path:
        options = f"remount,size={count}" if place.is_mount() else f"size={count}"
        tried = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", place], capture_output=True, text=True)
        if tried.returncode:
            pytest.skip(f"a small disk needs root: {tried.stderr}")
        return place

    yield of_size
    if place.is_mount():
        subprocess.run(["umount", "--lazy", place], check=True)
