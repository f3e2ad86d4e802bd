"""Calibrations: files, keys, levels between coverages, and messages."""

import numpy as np
import pytest
import yaml
from helpers import calibration

from sat_intervals import match_arrays
from sat_intervals.config import ConfigError, calibration_of, key_of, load_calibration, load_config, resolved, unreached
from sat_intervals.config.calibration import COVERAGES, at

RANGE = {"disparity": {"minimum": -3, "maximum": 5}}


def rising(**changes):
    """A calibration of the default settings with levels 0, 10, 20, ... and 0, 1, 2, ..., and changes to its rows."""
    values = calibration(load_config(RANGE), 0, 0, 0.9)
    for i, row in enumerate(values["levels"]):
        row |= {"high": 10.0 * i, "edge": 20.0 * i, "low": float(i)} | changes.get(f"row_{i}", {})
    return values


def numbers(levels):
    return levels.high, levels.low, levels.quantile


def test_at__gives_the_rows_and_is_linear_between() -> None:
    loaded = load_calibration(rising(row_1={"quantile": 0.5}))
    for i, coverage in enumerate(COVERAGES):
        assert at(loaded, coverage) == loaded.levels[i]
    assert numbers(at(loaded, 0.925)) == pytest.approx((55, 5.5, 0.9))
    assert at(loaded, 0.925).coverage == 0.925
    assert at(loaded, 0.925).edge == pytest.approx(110)


def test_at__between_two_quantiles_takes_level_and_quantile_of_the_larger_coverage() -> None:
    loaded = load_calibration(rising(row_1={"quantile": 0.5}, row_2={"quantile": None}))
    assert numbers(at(loaded, 0.55)) == pytest.approx((5, 1, 0.5))
    assert numbers(at(loaded, 0.65)) == pytest.approx((15, 2, None))
    assert numbers(at(loaded, 0.75)) == pytest.approx((25, 3, 0.9))


def test_unreached__names_a_coverage_that_the_calibration_does_not_reach(caplog) -> None:
    """Between two rows, that of the larger coverage counts. A run says so, see tests of the commands."""
    content = rising(row_8={"reached": False})

    def line(**interval):
        return unreached(load_config(RANGE, {"interval": interval}))

    assert line(alpha=0.9) == line(coverage=0.975, calibration=content) == ""
    for coverage in (0.98, 0.99):
        assert f"calibration flat do not reach coverage {coverage}" in line(coverage=coverage, calibration=content)
    settings = RANGE | {"interval": {"coverage": 0.99, "calibration": content}}
    match_arrays(np.eye(20), np.eye(20), settings)
    assert "do not reach coverage 0.99" in caplog.text


def test_load_calibration__reads_a_file_and_a_run_keeps_its_content(tmp_path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(yaml.safe_dump(rising() | {"provenance": {"scenes": ["one"]}}))
    config = resolved(load_config(RANGE, {"interval": {"coverage": 0.9, "calibration": str(file)}}))
    file.unlink()
    assert load_config(config.model_dump(mode="json")) == config
    assert calibration_of(config).provenance == {"scenes": ["one"]}
    assert calibration_of(config).sha256 == load_calibration(rising()).sha256
    assert numbers(config.cuts) == (50, 5, 0.9)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            rising(row_4={"high": 20.0}),
            "levels: high falls from 30 at coverage 0.8 to 20 at 0.85: a level may not fall",
        ),
        (rising(row_4={"edge": 20.0}), "levels: edge falls from 60 at coverage 0.8 to 20 at 0.85"),
        (rising(row_4={"low": 0.5}), "levels: low falls from 3 at coverage 0.8 to 0.5 at 0.85"),
        (rising(row_4={"coverage": 0.84}), "levels: coverages are 0.5, 0.6, 0.7, 0.8, 0.84, 0.9"),
        (rising(row_4={"high": -1.0}), "levels.4.high: input should be greater than or equal to 0"),
        ({"name": "x"}, "key: field required"),
        ([1], "holds [1], allowed: keys name, key, levels, provenance"),
        ("{", "line 1:"),
        ({"interval": {"coverage": 0.9}}, "own.yaml has settings, not a calibration: give it by --config"),
    ],
)
def test_load_calibration__names_the_file_and_the_error(tmp_path, values, words) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(values if isinstance(values, str) else yaml.safe_dump(values))
    with pytest.raises(ConfigError) as caught:
        load_config(RANGE, {"interval": {"coverage": 0.9, "calibration": str(file)}})
    assert str(file) in str(caught.value)
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_load_config__a_calibration_is_no_file_of_settings(tmp_path) -> None:
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(rising()))
    with pytest.raises(ConfigError, match=r"own.yaml is a calibration: give it by --calibration"):
        load_config(tmp_path / "own.yaml")


def test_load_calibration__names_a_missing_file() -> None:
    with pytest.raises(ConfigError, match=r"calibration no.yaml: No such file or directory .*sat-intervals calibrate"):
        load_calibration("no.yaml")


def test_calibration_of__an_older_one_has_no_factors_for_edges() -> None:
    config = load_config(RANGE, {"interval": {"coverage": 0.9, "calibration": rising(row_4={"edge": None})}})
    with pytest.raises(ConfigError, match="calibration flat has no factors for edges, an older version made it: make"):
        calibration_of(config)


@pytest.mark.parametrize(
    ("settings", "difference"),
    [
        ({"cost": {"window": 5}}, "cost.window is 7 in the calibration and 5 in the settings"),
        ({"sgm": {"p2": 64}}, "sgm.p2 is 144 in the calibration and 64 in the settings"),
        ({"median": None}, "median.size is 3 in the calibration and null in the settings"),
    ],
)
def test_calibration_of__refuses_one_of_other_settings(settings, difference) -> None:
    interval = {"coverage": 0.9, "calibration": rising()}
    here = load_config(RANGE, {"interval": interval} | settings)
    with pytest.raises(ConfigError) as caught:
        resolved(here)
    assert f"calibration flat belongs to other settings, {difference}: make one with sat-intervals calibrate" in str(
        caught.value
    )


@pytest.mark.parametrize(("more", "difference"), [({"extra": None}, "extra"), ({"extra": {}}, "extra")])
def test_calibration_of__names_an_edited_key(more, difference) -> None:
    content = rising()
    content["key"] = key_of(load_config(RANGE)) | more
    with pytest.raises(ConfigError, match=f"belongs to other settings, {difference} is "):
        resolved(load_config(RANGE, {"interval": {"coverage": 0.9, "calibration": content}}))


def test_key_of__leaves_out_what_levels_do_not_depend_on() -> None:
    one = load_config(RANGE)
    other = load_config(
        {"disparity": {"minimum": 0, "maximum": 60}, "interval": {"alpha": 0.5}, "regularization": {"quantile": 0.7}}
    )
    assert key_of(one) == key_of(other)


def test_key_of__of_mccnn_has_the_digest_of_its_weights(tmp_path) -> None:
    weights = tmp_path / "net.onnx"
    keys = []
    for content in (b"one", b"other"):
        weights.write_bytes(content)
        keys.append(key_of(load_config(RANGE, {"cost": {"method": "mccnn", "weights": str(weights)}})))
    assert keys[0] != keys[1]
    assert len(keys[0]["cost"]["weights"]) == 64


def test_calibration_of__without_one_names_the_command() -> None:
    config = load_config(RANGE, {"cost": {"window": 9}, "interval": {"coverage": 0.9}})
    nearest = (
        r"\(that of satellite is the nearest: cost.window is 7 in the calibration and 9 in the settings, span is .*\)"
    )
    with pytest.raises(ConfigError, match=rf"no built-in .* settings {nearest}: .* calibrate"):
        resolved(config)


# --- settings of the interval


def test_load_config__coverage_of_the_command_line_takes_the_place_of_alpha() -> None:
    interval = load_config(RANGE | {"interval": {"alpha": 0.8}}, {"interval": {"coverage": 0.95}}).interval
    assert (interval.alpha, float(interval.coverage)) == (None, 0.95)
    assert load_config(RANGE, {"preset": "paper", "interval": {"coverage": 0.95}}).interval == interval
    back = load_config(RANGE | {"interval": {"coverage": 0.8, "calibration": rising()}}, {"interval": {"alpha": 0.7}})
    assert (float(back.interval.alpha), back.interval.coverage, back.interval.calibration) == (0.7, None, None)
    assert load_config(RANGE, {"interval": {"alpha": 0.7}}).interval == back.interval
    kept = load_config(
        RANGE | {"interval": {"coverage": 0.8, "calibration": rising()}}, {"interval": {"coverage": 0.7}}
    )
    assert kept.interval.calibration == load_calibration(rising())


@pytest.mark.parametrize(
    ("interval", "words"),
    [
        ({"alpha": 0.8, "coverage": 0.9}, "interval: alpha is 0.8 and coverage 0.9: leave one out or set it to null"),
        ({"coverage": 0.995}, "interval.coverage is 0.995, allowed: number >= 0.5, <= 0.99 or null"),
        ({"alpha": 0.8, "calibration": rising()}, "interval: calibration goes with coverage only"),
        ({"coverage": 0.9, "calibration": 3}, "interval.calibration: calibration is 3, allowed: a file"),
    ],
)
def test_load_config__explains_intervals(interval, words) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(RANGE, {"interval": interval})
    assert words in str(caught.value)


def test_load_config__a_coverage_needs_classes_of_confidence() -> None:
    with pytest.raises(ConfigError, match=r"interval has a coverage and regularization null, .*: give regulariz"):
        load_config(RANGE, {"regularization": None})


def test_bound_steps__fit_in_16_bits() -> None:
    def steps(count):
        return load_config({"disparity": {"minimum": -16000, "maximum": count - 16001}}).bound_steps

    assert [steps(count) for count in (1, 1024, 1025, 2048, 32001)] == [64, 64, 32, 32, 2]
    assert load_config(RANGE | {"preset": "paper"}).bound_steps == 1
