"""MC-CNN from end to end: networks found and refused, features without padding, tiles, files, figures."""

import json
import sys
import warnings
from importlib import metadata
from importlib.metadata import version

import numpy as np
import onnx
import pytest
import rasterio
import reference
from helpers import bands, invoke
from networks import random_weights, slow_features, trained_network, write_network

from sat_intervals import RunError, SatIntervalsError, load_config, match_arrays, match_pair
from sat_intervals.config.costs import weights_file
from sat_intervals.errors import ChangedInputError
from sat_intervals.kernels.matching import cost_volume
from sat_intervals.match.costs import cost_of
from sat_intervals.match.matching_cost import Area, Given
from sat_intervals.match.mccnn import Network, load_network
from sat_intervals.match.normalization import ImageStatistics, PairStatistics
from sat_intervals.match.patch import kernel_settings
from sat_intervals.match.whole import cut, whole_view
from sat_intervals.products import COSINE_STEPS, IMPOSSIBLE_COST, INVALID
from sat_intervals.results import open_results
from sat_intervals.run.job import open_job
from sat_intervals.run.tile import match_block
from sat_intervals.show.cost_curve import read_curve
from sat_intervals.tiling import Window

pytestmark = [
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),
    pytest.mark.peer("onnxruntime", "mc_cnn"),
]


@pytest.fixture(scope="module")
def weights():
    return random_weights()


@pytest.fixture(scope="module")
def network_file(weights, tmp_path_factory):
    return write_network(tmp_path_factory.mktemp("network") / "small.onnx", weights)


@pytest.fixture(scope="module")
def fp32(shared_data, tmp_path_factory):
    return trained_network(shared_data, tmp_path_factory.mktemp("network") / "mb.onnx")


def settings(minimum, maximum, weights="full", **sections):
    cost = {"method": "mccnn", "weights": str(weights)}
    return load_config(
        {"preset": "mccnn", "disparity": {"minimum": minimum, "maximum": maximum}, "cost": cost} | sections
    )


def masked_images(rows=34, columns=46, seed=1):
    """A pair with a hole and without data in a corner of either image."""
    random = np.random.default_rng(seed)
    left = random.normal(500, 80, (rows, columns)).astype(np.float32)
    right = np.roll(left, 3, axis=1) + random.normal(0, 10, left.shape).astype(np.float32)
    masks = np.zeros((2, rows, columns), bool)
    masks[0, rows // 2, columns - 6] = masks[1, :4, : columns // 4] = masks[0, -3:, -4:] = True
    return [np.ma.masked_array(image, mask) for image, mask in zip((left, right), masks, strict=True)]


# ---- Networks ----------------------------------------------------------------------------------------------
def test_weights_file__is_found_without_importing_its_package():
    names = {"full": "mc_cnn_fast_int8_excl_01.onnx", "depthwise": "mc_cnn_fast_dw.onnx"}
    for name, official in names.items():
        file = weights_file(name)
        assert file.name == official
        assert load_network(file) is load_network(file)
        assert load_network(file).count == 64
    assert "mc_cnn" not in sys.modules


def test_load_network__refuses_weights_in_another_file(tmp_path):
    model = onnx.load(write_network(tmp_path / "one.onnx", random_weights()))
    onnx.save(model, tmp_path / "two.onnx", save_as_external_data=True, size_threshold=64)
    with pytest.raises(SatIntervalsError, match=r"two.onnx has weights in another file, .*: save the netwo"):
        load_network(tmp_path / "two.onnx")


def test_weights_file__names_the_missing_extra(monkeypatch):
    def nowhere(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr("sat_intervals.config.costs.files", nowhere)
    with pytest.raises(SatIntervalsError, match=r"needs the package MCCNN: pip install 'sat-intervals\[mccnn\]'"):
        weights_file("full")


def test_network__names_the_missing_onnxruntime(network_file, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(SatIntervalsError, match=r"needs onnxruntime: pip install 'sat-intervals\[mccnn\]'"):
        Network(network_file, network_file.read_bytes())


def test_network__is_a_valid_convolution(network_file, weights):
    pixels = np.random.default_rng(0).standard_normal((19, 24), np.float32)
    features = load_network(network_file)(pixels)
    np.testing.assert_allclose(features, slow_features(weights, pixels), atol=1e-5)


@pytest.mark.parametrize(
    ("options", "layers", "message"),
    [
        ({"unit": False}, 5, r"gives vectors of length .*, not 1: give a network with the form of MC-CNN fast"),
        ({"pads": 1}, 5, r"maps an image of 11 x 24 to \(8, 11, 24\)"),
        ({}, 3, r"maps an image of 11 x 24 to \(8, 5, 18\)"),
        ({"rank": 4}, 5, r"maps \[\[1, 1, 'height', 'width'\]\]"),
    ],
)
def test_network__another_form_is_refused(tmp_path, options, layers, message):
    file = write_network(tmp_path / "other.onnx", random_weights(layers=layers), **options)
    with pytest.raises(SatIntervalsError, match=message) as caught:
        match_arrays(np.zeros((20, 20)), np.zeros((20, 20)), settings(0, 1, file))
    assert len(str(caught.value).splitlines()) == 1


def test_network__no_network_is_refused(tmp_path):
    file = tmp_path / "text.onnx"
    file.write_text("weights")
    with pytest.raises(SatIntervalsError, match=r"text\.onnx is not a valid ONNX network"):
        load_network(file)
    with pytest.raises(SatIntervalsError, match=r"cost\.weights .*none\.onnx: no such file"):
        match_arrays(np.zeros((20, 20)), np.zeros((20, 20)), settings(0, 1, tmp_path / "none.onnx"))


# ---- Costs and penalties -----------------------------------------------------------------------------------
def costs_of(left, right, areas, config, statistics):
    cost = cost_of(config, Given(statistics))
    return cost.of_areas(tuple(map(cut, map(whole_view, (left, right)), cost.windows(areas))), areas)


@pytest.mark.parametrize("mirrored", [False, True])
def test_compare__costs_equal_reference(network_file, weights, mirrored):
    # Three strips of rows at most; pixels of no data are filled, and windows that meet them are impossible.
    left, right = masked_images(rows=150)
    config = settings(-6, 3, network_file, sgm=None)
    statistics = PairStatistics(ImageStatistics(490.0, 75.0), ImageStatistics(510.0, 85.0))
    area = Area.of(Window(5, 2, 140, 30), config, mirrored)
    (found,) = costs_of(left, right, [area], config, statistics)
    volume = cost_volume(found.costs, kernel_settings(config))

    def features(image, statistics, window):
        _, pixels, state = cut(whole_view(image), window.grown(5, 5))
        pixels = np.where(state == 0, (pixels - statistics.mean) / statistics.deviation, 0)
        return slow_features(weights, pixels), reference.window_state(state, 11)

    images = (
        ((right, statistics.right), (left, statistics.left))
        if mirrored
        else ((left, statistics.left), (right, statistics.right))
    )
    (base, base_state), (there, there_state) = (
        features(*image, window) for image, window in zip(images, (area.base, area.facing), strict=True)
    )
    possible = reference.possible(base_state, there_state)
    np.testing.assert_array_equal(volume != IMPOSSIBLE_COST, possible)
    expected = COSINE_STEPS * reference.correlation(base, there)
    assert np.abs(volume - expected)[possible].max() <= 0.51
    assert 0.3 < possible.mean() < 0.95


def test_compare__penalties_follow_both_images(network_file):
    # The same penalties by the method's text: edges of normalised images, the right one where a candidate faces it.
    left, right = masked_images(rows=16, columns=22)
    config = settings(-2, 2, network_file, sgm={"p1": 0.5, "p2": 4, "q1": 2, "q2": 5, "v": 2, "d": 1.1, "span": 40})
    statistics = PairStatistics(ImageStatistics(500.0, 80.0), ImageStatistics(500.0, 90.0))
    whole = Window(0, 0, *left.shape)
    (found,) = costs_of(left, right, [Area.of(whole, config)], config, statistics)
    cost = found.costs.left[:, :, :5].astype(int)
    states = found.costs.left_state, found.costs.right_state
    cost[~reference.possible(*states)] = IMPOSSIBLE_COST
    # 125 steps: P1 62.5, 31.25, 6.25, half of them on vertical paths; P2 500, 250, 50; halves are rounded up.
    p1, vertical, p2 = (63, 31, 6), (31, 16, 3), (500, 250, 50)
    images = found.gradients.left.astype(float), found.gradients.right.astype(float)
    edges = 1.1 * 80, 1.1 * 90

    def penalties(step):
        return reference.edge_penalties(*images, 5, step, (vertical if step[1] == 0 else p1, p2), edges)

    expected = reference.aggregate_with(cost, 250 + 500 + 125, penalties)
    np.testing.assert_array_equal(cost_volume(found.costs, kernel_settings(config), found.gradients), expected)


def test_compare__a_right_area_is_a_left_one_of_swapped_images(network_file):
    left, right = masked_images()
    statistics = PairStatistics(ImageStatistics(490.0, 75.0), ImageStatistics(510.0, 85.0))
    config, swapped = (settings(*ends, network_file) for ends in ((-6, 3), (-3, 6)))
    window = Window(3, -4, 20, 30)
    both = [Area.of(Window(3, 1, 20, 25), config), Area.of(window, config, mirrored=True)]
    _, found = costs_of(left, right, both, config, statistics)
    swapped_statistics = PairStatistics(statistics.right, statistics.left)
    (expected,) = costs_of(right, left, [Area.of(window, swapped)], swapped, swapped_statistics)
    for one, other in zip(found.costs[2:], expected.costs[2:], strict=True):
        np.testing.assert_array_equal(one, other)
    volumes = (cost_volume(one.costs, kernel_settings(swapped), one.gradients) for one in (found, expected))
    np.testing.assert_array_equal(*volumes)


def test_config__span_is_declared_and_held_to_what_can_be():
    config = settings(-9, 0)
    assert config.cost_span == round(125 * float(config.sgm.span)) < config.largest_sum
    assert len(config.ambiguity_weights) == config.largest_sum + 1
    assert settings(-9, 0, sgm=None).cost_span == 250
    with pytest.raises(SatIntervalsError, match=r"sgm\.span is 60, allowed: <= 48 with p2 4"):
        settings(-9, 0, sgm={"p2": 4, "span": 60})
    with pytest.raises(SatIntervalsError, match=r"sgm\.p2 is 70, allowed: <= 63 with cost\.method mccnn"):
        settings(-9, 0, sgm={"p2": 70, "span": 16})
    assert settings(-9, 0, sgm={"p1": 0.5, "d": 0.08}) == settings(-9, 0)


# ---- Runs --------------------------------------------------------------------------------------------------
def write(path, image, nodata=0):
    kind = {"height": image.shape[0], "width": image.shape[1], "count": 1, "dtype": "uint16", "nodata": nodata}
    with rasterio.open(path, "w", driver="GTiff", **kind) as file:
        file.write(image.filled(0).astype("uint16"), 1)
    return path


@pytest.mark.parametrize("method", ["fast", "accurate"])
def test_match_pair__equals_match_arrays_and_keeps_what_decides(tmp_path, network_file, method):
    left, right = (np.ma.masked_array(image.data.astype("uint16"), image.mask) for image in masked_images(70, 90))
    config = settings(-4, 6, network_file, cross_check={"method": method})
    images = write(tmp_path / "left.tif", left), write(tmp_path / "right.tif", right)
    run = match_pair(*images, tmp_path / "out", config)
    found, flags = bands(tmp_path / "out")
    expected = match_arrays(left, right, config)
    np.testing.assert_array_equal(flags, expected["validity"])
    np.testing.assert_array_equal(found[0], expected["disparity"])
    for band, name in zip(found[1:], ("lower", "upper", "confidence"), strict=True):
        np.testing.assert_allclose(band, expected[name], atol=1e-6)
    assert 0.2 < (flags & INVALID == 0).mean() < 1
    assert run["inputs"]["weights"]["path"] == str(network_file)
    assert len(run["inputs"]["weights"]["sha256"]) == 64
    assert run["normalization"]["left"] == pytest.approx({"mean": left.mean(), "deviation": left.std()})
    assert run["normalization"]["right"] == pytest.approx({"mean": right.mean(), "deviation": right.std()})
    assert load_config(run["settings"]) == config


def test_match__preset_mccnn_brings_its_penalties_and_curves_are_drawn(tmp_path):
    left, right = masked_images(60, 80)
    images = write(tmp_path / "left.tif", left), write(tmp_path / "right.tif", right)
    planned = invoke("plan", *images, "--disparity", -4, 6, "--preset", "mccnn")
    assert planned.exit_code == 0, planned.output
    matched = invoke("match", *images, tmp_path / "out", "--disparity", -4, 6, "--preset", "mccnn")
    assert matched.exit_code == 0, matched.output
    assert "measuring images" in matched.stdout
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert load_config(run["settings"]) == settings(-4, 6)
    assert run["cost_span"] == settings(-4, 6).cost_span
    # One tile without seams: the curve of a pixel is that of the run.
    results = open_results(tmp_path / "out")
    found, flags = bands(tmp_path / "out")
    row, column = next((r, c) for r, c in np.argwhere(flags & INVALID == 0) if r > 20)
    curve = read_curve(results, row, column)
    raw = match_arrays(left.astype("uint16"), right.astype("uint16"), settings(-4, 6, median=None, regularization=None))
    assert curve.disparity == pytest.approx(raw["disparity"].to_numpy()[row, column])
    assert curve.lower <= found[0, row, column] <= curve.upper
    assert np.nanmin(curve.possibilities) >= 0
    results.report["inputs"]["weights"]["sha256"] = "0"
    with pytest.raises(ChangedInputError, match=r"has other weights than the run"):
        read_curve(results, row, column)


def test_match_tile__other_weights_on_a_worker_are_noticed(tmp_path):
    left, right = masked_images(60, 80)
    images = write(tmp_path / "left.tif", left), write(tmp_path / "right.tif", right)
    file = write_network(tmp_path / "network.onnx", random_weights())
    job = open_job(*images, tmp_path / "out", settings(-4, 6, file))
    job.begin()
    write_network(file, random_weights(seed=1))
    for content in (file.read_bytes(), file.read_bytes()[:99]):
        file.write_bytes(content)
        with pytest.raises(ChangedInputError, match=r"network\.onnx has other weights than the run"):
            match_block(job, next(iter(job.store.grid)))


def test_match_tile__another_onnxruntime_on_a_worker_is_noticed(tmp_path, network_file, monkeypatch):
    left, right = masked_images(60, 80)
    images = write(tmp_path / "left.tif", left), write(tmp_path / "right.tif", right)
    job = open_job(*images, tmp_path / "out", settings(-4, 6, network_file))
    job.begin()
    installed = version("sat-intervals")
    monkeypatch.setattr("sat_intervals.run.job.version", lambda name: "0.1" if name == "onnxruntime" else installed)
    with pytest.raises(RunError, match=r"onnxruntime is 0.1 here, but the run has .*: install the same for all"):
        match_block(job, next(iter(job.store.grid)))


@pytest.mark.parametrize("name", ["int8", "fp32"])
def test_match_arrays__is_as_accurate_as_asked_on_development_scenes(shared_data, fp32, name):
    # Share of intervals that hold the truth and median width over that of the search, of all kept pixels of a group.
    of_2005 = ("art", "books", "dolls", "laundry", "moebius", "reindeer")
    groups = {
        ("mb2003_cones", "mb2003_teddy"): (0.954, 0.038),
        tuple(f"mb2005_{scene}" for scene in of_2005): (0.955, 0.035),
        ("synth_toulouse_urban",): (0.93, 0.10),
        ("synth_toulouse_nodata",): (0.93, 0.10),
    }
    for scenes, (accuracy, size) in groups.items():
        inside, sizes = [], []
        for scene in scenes:
            folder = shared_data / scene
            minimum, maximum = json.loads((folder / "meta.json").read_text())["disparity"]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
                left, right, truth = (rasterio.open(folder / f"{layer}.tif") for layer in ("left", "right", "truth"))
            with left, right, truth:
                config = settings(minimum, maximum, fp32 if name == "fp32" else "full")
                result = match_arrays(left.read(1, masked=True), right.read(1, masked=True), config)
                true = truth.read(1)
            lower, upper = result["lower"].to_numpy(), result["upper"].to_numpy()
            judged = np.isfinite(lower) & np.isfinite(true)
            inside.append(((lower <= true) & (true <= upper))[judged])
            sizes.append((upper - lower)[judged] / (maximum - minimum))
        assert np.concatenate(inside).mean() >= accuracy
        assert np.median(np.concatenate(sizes)) <= size
