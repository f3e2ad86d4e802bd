"""Comparison with Pandora and its plugins libSGM and MC-CNN on real pairs (METHOD.md, section 12).

Both sides get the same files, no-data value and settings. Unless a test says otherwise it compares the
*whole* pixels: those whose whole search range is possible. The agreed bars are 99.99 % of the samples and
99.9 % of the pixels; measured are all of them, so that is what is asked. Each test names what could make a
pixel differ all the same, on another pair or with another Pandora.
"""

import json
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
import rasterio
import xarray as xr
from networks import trained_network

from sat_intervals import intervals_of, load_config, match_arrays
from sat_intervals.config import Config
from sat_intervals.config.costs import weights_file
from sat_intervals.kernels.cost import Codes, between, census
from sat_intervals.kernels.matching import cost_volume
from sat_intervals.match.mccnn import load_network
from sat_intervals.match.normalization import moments, statistics_of
from sat_intervals.match.patch import kernel_settings
from sat_intervals.products import IMPOSSIBLE_COST, NO_DATA

# Our reading of the pairs, which have no georeferencing. Pandora and its plugin raise no warning.
pytestmark = [
    pytest.mark.peer("pandora", "pandora_plugin_libsgm", "pandora_plugin_mc_cnn"),
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),
]

# Middlebury without no data; real Pleiades, of which a third is no data (0).
PAIRS = ("mb2003_cones", "phr_picanteo_pre")

PIPELINE = {
    "matching_cost": {"matching_cost_method": "census", "window_size": 5, "subpix": 1},
    "optimization": {
        "optimization_method": "sgm",
        "overcounting": False,
        "min_cost_paths": False,
        "penalty": {"penalty_method": "sgm_penalty", "p2_method": "constant", "P1": 8, "P2": 32},
    },
    "cost_volume_confidence.bounds": {"confidence_method": "interval_bounds", "possibility_threshold": 0.9},
    "cost_volume_confidence.ambiguity": {"confidence_method": "ambiguity", "normalization": False},
    "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
    "refinement": {"refinement_method": "vfit"},
}

# The same steps; those that come after them are off, so that products are raw.
SETTINGS = {
    "preset": "paper",
    "cost": {"method": "census", "window": 5},
    "sgm": {"p1": 8, "p2": 32},
    "interval": {"alpha": 0.9},
    "refinement": {"method": "vfit"},
    "ambiguity": None,
    "cross_check": None,
    "median": None,
    "regularization": None,
}


class Pair(NamedTuple):
    """A real pair: images masked where they are no data, and the settings with its search range."""

    folder: Path
    no_data: int | None
    left: np.ma.MaskedArray
    right: np.ma.MaskedArray
    config: Config


class Peer(NamedTuple):
    """Pandora's dataset of costs, NaN = impossible, which are ``(rows, columns, k)``; and bands ``(rows, columns)``."""

    dataset: xr.Dataset
    volume: np.ndarray
    winner: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    disparity: np.ndarray

    @property
    def possible(self) -> np.ndarray:
        return np.isfinite(self.volume)

    @property
    def whole(self) -> np.ndarray:
        return self.possible.all(axis=2)


@pytest.fixture(scope="module")
def pandora() -> ModuleType:
    for name in ("pandora.check_configuration", "pandora.img_tools", "pandora.state_machine"):
        import_module(name)
    module = import_module("pandora")
    module.import_plugin()
    return module


@pytest.fixture(scope="module", params=PAIRS)
def pair(request: pytest.FixtureRequest, shared_data: Path) -> Pair:
    folder = shared_data / request.param
    minimum, maximum = json.loads((folder / "meta.json").read_text())["disparity"]
    config = load_config(SETTINGS | {"disparity": {"minimum": minimum, "maximum": maximum}})
    with rasterio.open(folder / "left.tif") as left, rasterio.open(folder / "right.tif") as right:
        assert left.nodata == right.nodata
        no_data = None if left.nodata is None else int(left.nodata)
        return Pair(folder, no_data, left.read(1, masked=True), right.read(1, masked=True), config)


def run_pandora(pandora: ModuleType, pair: Pair, pipeline: dict[str, Any]) -> Peer:
    no_data = "NaN" if pair.no_data is None else pair.no_data
    left, right = ({"img": str(pair.folder / f"{side}.tif"), "nodata": no_data} for side in ("left", "right"))
    left["disp"] = [pair.config.disparity.minimum, pair.config.disparity.maximum]
    machine = pandora.state_machine.PandoraMachine()
    settings = {"input": {"left": left, "right": right}, "pipeline": pipeline}
    settings = pandora.check_configuration.check_conf(settings, machine)
    read = pandora.img_tools.create_dataset_from_inputs
    images = read(settings["input"]["left"]), read(settings["input"]["right"])
    refined, _ = pandora.run(machine, *images, settings)
    bounds = machine.left_cv["confidence_measure"]
    return Peer(
        dataset=machine.left_cv,
        volume=machine.left_cv["cost_volume"].data,
        winner=machine.left_cv["disp_indices"].data,
        lower=bounds.sel(indicator="confidence_from_interval_bounds_inf.bounds").data,
        upper=bounds.sel(indicator="confidence_from_interval_bounds_sup.bounds").data,
        disparity=refined["disparity_map"].data,
    )


@pytest.fixture(scope="module")
def peer(pandora: ModuleType, pair: Pair) -> Peer:
    return run_pandora(pandora, pair, PIPELINE)


@pytest.fixture(scope="module")
def peer_before(pandora: ModuleType, pair: Pair) -> Peer:
    """Before libSGM."""
    return run_pandora(pandora, pair, {name: step for name, step in PIPELINE.items() if name != "optimization"})


@pytest.fixture(scope="module")
def ours(pair: Pair) -> xr.Dataset:
    return match_arrays(pair.left, pair.right, pair.config)


@pytest.fixture(scope="module")
def ours_unrefined(pair: Pair) -> xr.Dataset:
    """Without refinement the disparity is the winner, and the interval the alpha-cut itself."""
    return match_arrays(pair.left, pair.right, pair.config.model_dump() | {"refinement": None})


@pytest.fixture(scope="module")
def our_volume(pair: Pair) -> np.ndarray:
    window, search = pair.config.cost.window, pair.config.disparity
    left = census_codes(pair.left, window, 0, 0)
    right = census_codes(pair.right, window, -search.minimum, search.maximum)
    return cost_volume(between(left, right), kernel_settings(pair.config))


def census_codes(image: np.ma.MaskedArray, window: int, before: int, after: int) -> Codes:
    """Codes of an image and of some columns before and after it."""
    radius = window // 2
    margin = (radius, radius), (radius + before, radius + after)
    state = np.where(np.ma.getmaskarray(image), NO_DATA, 0).astype(np.uint8)
    pixels = np.pad(image.filled(0).astype(np.float32), margin)
    return census(pixels, np.pad(state, margin, constant_values=NO_DATA), window)


def test_cost_volume__has_pandoras_possible_candidates(peer: Peer, our_volume: np.ndarray) -> None:
    # Everywhere, borders included: both ask for whole windows without no data in both images.
    np.testing.assert_array_equal(our_volume != IMPOSSIBLE_COST, peer.possible)
    assert 0.5 < peer.whole.mean() < 1.0


def test_cost_volume__equals_libsgm_on_whole_pixels(peer: Peer, our_volume: np.ndarray) -> None:
    # A whole pixel can differ where a path comes from pixels of truncated range, see the next test.
    np.testing.assert_array_equal(our_volume[peer.whole], peer.volume[peer.whole])


def test_cost_volume__equals_libsgm_where_possible(peer: Peer, our_volume: np.ndarray) -> None:
    # On 99.99 % of all possible candidates, those of truncated ranges included. Cause of what differs: at an
    # impossible candidate libSGM holds the path's cost at the candidate's own, where ours goes on by the
    # recursion and may be higher by up to P2. It shows only behind pixels whose possible candidates all fit
    # badly, where the step from an impossible candidate is the cheapest.
    equal = our_volume[peer.possible] == peer.volume[peer.possible]
    assert equal.mean() >= 0.9999


def test_cost_span__is_what_pandora_measures(peer: Peer, pair: Pair) -> None:
    # Pandora statistics possibility by the lowest and the highest cost of all possible candidates of the image,
    # those of truncated ranges included. Where an image does not attain the declared span, Pandora's cut is
    # narrower.
    assert np.nanmin(peer.volume) == 0
    assert np.nanmax(peer.volume) == pair.config.cost_span


def test_match_arrays__winners_equal_pandoras(peer: Peer, ours_unrefined: xr.Dataset) -> None:
    # Both take the smallest disparity at ties: a winner can differ only where the volume does.
    np.testing.assert_array_equal(ours_unrefined["disparity"].data[peer.whole], peer.winner[peer.whole])


@pytest.mark.parametrize("bound", ["lower", "upper"])
def test_match_arrays__raw_bounds_equal_pandoras(peer: Peer, ours: xr.Dataset, bound: str) -> None:
    # Pandora's possibility is float32, our threshold an exact integer: they can part at exact ties. There are
    # none with these settings, as (1 - 0.9) * 448 = 44.8. Both bounds are extended for the refinement.
    np.testing.assert_array_equal(ours[bound].data[peer.whole], getattr(peer, bound)[peer.whole])


def test_match_arrays__disparities_equal_pandoras_but_for_rounding(peer: Peer, ours: xr.Dataset) -> None:
    # Pandora rounds the shift to float32 and then its sum with the winner, we round once. Agreed are 1e-3 px.
    tolerance = 2 * np.spacing(np.float32(64))
    difference = ours["disparity"].data[peer.whole] - peer.disparity[peer.whole]
    assert np.abs(difference).max() <= tolerance


# ---- Pandora's volume --------------------------------------------------------------------------------------
def test_intervals_of__equals_pandora_after_libsgm_but_for_ties(peer: Peer) -> None:
    check_volume(peer, 448)


def test_intervals_of__equals_pandora_before_libsgm_but_for_ties(peer_before: Peer) -> None:
    check_volume(peer_before, 24)


def check_volume(peer: Peer, span: int) -> None:
    """Compare with Pandora on its volume, whose global range is the span, and quarters of it with the whole."""
    assert (np.nanmin(peer.volume), np.nanmax(peer.volume)) == (0, span)
    settings = SETTINGS | {"sgm": None, "ambiguity": {"normalization": "range"}}
    del settings["cost"]
    found, known = intervals_of(peer.dataset, span=span, config=settings), peer.possible.any(axis=2)
    # At every pixel with a candidate. There are no ties: (1 - 0.9) * 448 = 44.8 and (1 - 0.9) * 24 = 2.4.
    np.testing.assert_array_equal(found["lower"].data[known], peer.lower[known])
    np.testing.assert_array_equal(found["upper"].data[known], peer.upper[known])
    # A cost at exactly eta times the span above the lowest is ambiguous; Pandora's float32 loses some of them.
    etas, count = 70, peer.volume.shape[2]
    ours = np.rint((1 - found["confidence"].data) * etas * count)
    peers = 1 - peer.dataset["confidence_measure"].sel(indicator="confidence_from_ambiguity.ambiguity").data
    ties = [eta * span // 100 for eta in range(1, etas) if eta * span % 100 == 0]
    excess = peer.volume - np.fmin.reduce(peer.volume, axis=2, keepdims=True)
    lost = (ours - peers)[known]
    assert (lost >= 0).all()
    assert (lost <= np.isin(excess, ties).sum(axis=2)[known]).all()
    # The declared span makes quarters of the volume give the same.
    rows, columns = (size // 2 for size in known.shape)
    for there in (slice(0, rows), slice(rows, None)):
        for here in (slice(0, columns), slice(columns, None)):
            quarter = intervals_of(peer.dataset.isel(row=there, col=here), span=span, config=settings)
            xr.testing.assert_identical(quarter, found.isel(y=there, x=here))


# ---- MC-CNN ------------------------------------------------------------------------------------------------
def mccnn_peer(pandora, folder, search, weights=None):
    """Costs by Pandora's MC-CNN, ``(rows, columns, k)``."""
    import_module("pandora_plugin_mc_cnn")
    cost = {"matching_cost_method": "mc_cnn", "window_size": 11, "subpix": 1}
    pipeline = {"matching_cost": cost | ({"model_path": str(weights)} if weights else {})}
    pipeline["disparity"] = PIPELINE["disparity"]
    left, right = ({"img": str(folder / f"{side}.tif"), "nodata": "NaN"} for side in ("left", "right"))
    machine = pandora.state_machine.PandoraMachine()
    settings = {"input": {"left": left | {"disp": list(search)}, "right": right}, "pipeline": pipeline}
    settings = pandora.check_configuration.check_conf(settings, machine)
    read = pandora.img_tools.create_dataset_from_inputs
    pandora.run(machine, read(settings["input"]["left"]), read(settings["input"]["right"]), settings)
    return machine.left_cv["cost_volume"].data


def cones(shared_data):
    """Both images and the search range."""
    folder = shared_data / "mb2003_cones"
    images = []
    for side in ("left", "right"):
        with rasterio.open(folder / f"{side}.tif") as file:
            images.append(file.read(1))
    return folder, images, json.loads((folder / "meta.json").read_text())["disparity"]


@pytest.mark.parametrize(("kind", "equal"), [("fp32", 1.0), ("int8", 0.995)])
def test_features__have_the_cosines_of_pandora(pandora, shared_data, tmp_path, kind, equal):
    # Within 2e-3; of the int8 network not everywhere: the last bit of the mean, which Pandora takes of float32, decides
    # how some of its activations are rounded.
    folder, images, (minimum, maximum) = cones(shared_data)
    weights = trained_network(shared_data, tmp_path / "mb.onnx") if kind == "fp32" else None
    theirs = -mccnn_peer(pandora, folder, (minimum, maximum), weights)
    network = load_network(weights_file(str(weights or "full")))
    statistics = [statistics_of([moments(image, np.zeros(image.shape))]) for image in images]
    left, right = (
        network(((image - statistics.mean) / statistics.deviation).astype(np.float32))
        for image, statistics in zip(images, statistics, strict=True)
    )
    for k, d in enumerate(range(minimum, maximum + 1)):
        ours = (left[:, :, -d:] * right[:, :, : right.shape[2] + d]).sum(axis=0)
        near = np.abs(ours - theirs[5:-5, 5 - d : -5, k]) <= 2e-3
        # the reference loses the last columns, up to 7, at any disparity
        assert near[:, :-7].mean() >= equal
