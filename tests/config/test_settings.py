"""Settings: defaults, ranges, messages, shipped files, and the exact thresholds that follow from them."""

import re
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from sat_intervals.config import (
    PRESETS,
    Ambiguity,
    Census,
    Config,
    ConfigError,
    Disparity,
    Interval,
    Sgm,
    allowed,
    load_config,
    preset_text,
)

RANGE = {"disparity": {"minimum": -60, "maximum": 0}}


def settings(**sections: Any) -> Config:
    return load_config(RANGE, sections)


def message(source: Any, overrides: Mapping[str, Any] | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(source, overrides)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    return text


@pytest.fixture
def write(tmp_path: Path):
    def write(text: str | bytes) -> Path:
        file = tmp_path / "settings.yaml"
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return file

    return write


# --- defaults and shipped files


def test_load_config__completes_with_the_defaults() -> None:
    assert load_config(RANGE) == Config(disparity=Disparity(minimum=-60, maximum=0))


def test_default_yaml__holds_every_setting_at_its_default() -> None:
    values = yaml.safe_load(preset_text())
    assert list(values) == list(Config.model_fields)
    for name in ("preset", "rows"):
        assert values.pop(name) == getattr(settings(), name)
    for section, keys in values.items():
        model = getattr(settings(), section)
        assert list(keys) == list(type(model).model_fields)
    assert load_config(values, RANGE) == settings()


@pytest.mark.parametrize("name", PRESETS)
def test_preset_text__comments_every_setting_with_its_meaning_and_range(name: str) -> None:
    config = load_config(yaml.safe_load(preset_text(name)))
    section = None
    commented = []
    for line in preset_text(name).splitlines():
        if found := re.fullmatch(r"(\w+):", line):
            section = type(getattr(config, found[1]))
        elif found := re.fullmatch(r"(?:  |(?=preset|rows|\w+: null))(\w+): \S+ +# (.*)", line):
            section = section if line.startswith(" ") else Config
            field = section.model_fields[found[1]]
            about = "" if getattr(config, found[1], "") is None else f"{field.description} "
            assert found[2] == f"{about}({allowed(field)})"
            commented.append((section, found[1]))
        else:
            assert not line or line.startswith("#")
    expected = []
    for name in Config.model_fields:
        model = type(getattr(config, name))
        expected += [(Config, name)] if model in (str, NoneType) else [(model, key) for key in model.model_fields]
    assert commented == expected


def test_load_config__many_images_have_neither_a_right_view_nor_a_share_of_nothing() -> None:
    many = {"preset": "many"}
    assert settings(**many).cost.rejected == 0.05
    assert "has no right image: set cross_check to null" in message(many | {"cross_check": {"method": "fast"}})
    assert "refinement.method to vfit" in message(many | {"refinement": {"method": "least_squares"}})
    for key, value, allowed_values in (
        ("share", 0, "number > 0, <= 1"),
        ("pairs", 17, "integer >= 1, <= 16"),
        ("step", 0, "number > 0 or null"),
        ("doubtful", 1, "number >= 0, < 1"),
    ):
        assert message(many | {"cost": {key: value}}).endswith(f"cost.{key} is {value}, allowed: {allowed_values}")


# --- presets beside settings


@pytest.mark.parametrize("name", PRESETS)
def test_load_config__a_preset_fills_in_what_is_left_out(name: str, write) -> None:
    whole = load_config(yaml.safe_load(preset_text(name)), RANGE)
    assert load_config(RANGE | {"preset": name}) == load_config(RANGE, {"preset": name}) == whole
    assert load_config(write(f"preset: {name}\n"), RANGE) == whole
    assert load_config(whole.model_dump(mode="json")) == whole
    assert load_config(whole, {"tiles": {"size": 64}}).sgm == whole.sgm


def test_load_config__settings_beside_a_preset_win() -> None:
    config = settings(preset="paper", sgm={"p2": 99}, median=None)
    assert config.sgm == Sgm(p1=8, p2=99)
    assert config.cost == Census(window=5)
    assert config.median is None
    assert settings(preset="paper", cost={"window": 7}).sgm == Sgm(p1=8, p2=32)


def test_load_config__another_cost_beside_a_preset_takes_its_penalties_along() -> None:
    other = settings(cost={"method": "mccnn"})
    assert (other.cost, other.sgm) == (settings(preset="mccnn").cost, settings(preset="mccnn").sgm)
    assert settings(preset="mccnn", cost={"method": "census"}).sgm == Sgm()


def test_load_config__other_penalties_beside_a_preset_need_their_own_span() -> None:
    given = RANGE | {"preset": "satellite-mccnn", "sgm": {"p2": 7}}
    assert message(given).startswith("sgm.span is missing: it has no default with cost.method mccnn")
    config = settings(preset="satellite-mccnn", sgm={"p2": 7, "span": 60})
    assert (config.sgm.p1, config.sgm.span) == (Decimal("0.8"), 60)
    assert message(RANGE | {"preset": "mccnn", "sgm": {"p1": 0.6}}).startswith("sgm: span is missing: its default, 16")


def test_load_config__another_kind_of_penalties_beside_a_preset_takes_none_of_its_own() -> None:
    constant = {"penalty": "constant", "p1": 0.8, "p2": 4.5, "span": 48}
    assert settings(preset="mccnn", sgm=constant).sgm == settings(preset="satellite-mccnn").sgm
    edges = settings(preset="satellite-mccnn", sgm={"penalty": "mc_cnn_fast"}).sgm
    assert edges == settings(preset="mccnn").sgm
    own = settings(preset="satellite-mccnn", sgm={"penalty": "constant"})
    assert own == settings(preset="satellite-mccnn")


@pytest.mark.parametrize("named_by", ["file", "overrides"])
def test_load_config__penalties_beside_a_preset_stay_with_its_cost_and_go_with_another(named_by: str) -> None:
    preset = {"preset": "satellite-mccnn"}
    file = RANGE | {"sgm": {"p2": 4, "span": 45}} | (preset if named_by == "file" else {})
    more = preset if named_by == "overrides" else {}
    same = load_config(file, {"cost": {"method": "mccnn"}} | more)
    assert same == load_config(file, more)
    assert (same.sgm.p2, same.sgm.span) == (4, 45)
    assert load_config(file, {"cost": {"method": "census"}} | more).sgm == Sgm()


def test_config__takes_the_preset_for_what_is_left_out() -> None:
    assert Config(preset="paper") == load_config({"preset": "paper"})
    changed = Config(preset="paper", sgm=Sgm(p1=9))
    assert changed.sgm == load_config({"preset": "paper", "sgm": Sgm(p1=9)}).sgm == Sgm(p1=9, p2=32)


def test_load_config__two_presets_are_refused(write) -> None:
    file = write("preset: paper\n")
    expected = f"{file}: preset is 'paper', and 'mccnn' is asked for: leave one out"
    assert message(file, RANGE | {"preset": "mccnn"}) == expected
    assert load_config(file, RANGE | {"preset": "paper"}).preset == "paper"


# --- sources


def test_load_config__reads_a_file_by_path_or_name(write) -> None:
    file = write("disparity: {minimum: -60, maximum: 0}\nsgm: null\n")
    assert load_config(file) == load_config(str(file)) == settings(sgm=None)


@pytest.mark.parametrize("text", ["", "# only comments\n", "---\n"])
def test_load_config__takes_no_empty_file_for_the_defaults(write, text: str) -> None:
    """After a power loss a file may be empty."""
    with pytest.raises(ConfigError, match="has no settings, or was cut off: restore it, or leave it out"):
        load_config(write(text), RANGE)


def test_load_config__overrides_win_key_by_key() -> None:
    source = {"disparity": {"minimum": -60, "maximum": 0}, "sgm": {"p1": 4, "p2": 64}, "median": None}
    config = load_config(source, {"disparity": {"minimum": -9}, "sgm": {"p1": 2}, "median": {"size": 5}})
    assert config.disparity == Disparity(minimum=-9, maximum=0)
    assert config.sgm == Sgm(p1=2, p2=64)
    assert config.median is not None
    assert config.median.size == 5
    assert load_config(config, {"sgm": None}).sgm is None
    assert source["sgm"] == {"p1": 4, "p2": 64}


def test_load_config__takes_its_own_result_and_any_mapping() -> None:
    config = settings(interval={"alpha": 0.85})
    assert load_config(config) == config
    assert load_config(MappingProxyType(config.model_dump())) == config


def test_load_config__accepts_numpy_scalars() -> None:
    config = load_config({"disparity": {"minimum": np.int16(-9), "maximum": np.int64(3)}})
    assert config.disparity == Disparity(minimum=-9, maximum=3)
    assert settings(interval={"alpha": np.float64(0.9)}) == settings(interval={"alpha": 0.9})


@given(st.decimals(min_value="0.001", max_value="1", places=6))
def test_config__comes_back_from_json(alpha: Decimal) -> None:
    config = settings(interval={"alpha": float(alpha)}, median=None)
    assert config.interval == Interval(alpha=alpha)
    assert load_config(config.model_dump(mode="json")) == config
    assert Config.model_validate_json(config.model_dump_json()) == config


def test_config__is_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        settings().tiles.size = 64


@pytest.mark.parametrize("section", ["sgm", "refinement", "cross_check", "median", "ambiguity", "interval"])
def test_load_config__null_switches_a_step_off(section: str) -> None:
    config = settings(preset="paper", **{section: None, "regularization": None})
    assert getattr(config, section) is config.regularization is None


def test_largest_ambiguity__counts_every_eta_of_every_candidate() -> None:
    assert settings().largest_ambiguity == 70 * 61
    assert settings(ambiguity=None, interval=None, regularization=None).largest_ambiguity == 0


# --- what is refused

REFUSED = [
    # section, its keys, the message
    ("disparity", {"minimum": 5}, "disparity: minimum 5 is above maximum 0, swap them"),
    ("disparity", {"minimum": -16001}, "disparity.minimum is -16001, allowed: integer >= -16000, <= 16000"),
    ("disparity", {"maximum": "5"}, "disparity.maximum is '5', allowed: integer >= -16000, <= 16000"),
    ("disparity", None, "disparity is null, allowed: section of minimum, maximum, open_ends"),
    ("cost", {"method": "sad"}, "cost.method is 'sad', allowed: census or mccnn"),
    ("cost", {"method": "mccnn", "window": 5}, "unknown key 'cost.window' (known: method, weights)"),
    ("cost", {"method": "mccnn", "weights": 3}, "cost.weights is 3, allowed: text"),
    ("sgm", {"penalty": "linear"}, "sgm.penalty is 'linear', allowed: constant or mc_cnn_fast"),
    ("sgm", {"penalty": "mc_cnn_fast"}, "sgm.penalty is mc_cnn_fast, allowed: constant with cost.method census"),
    ("sgm", {"p1": 8.5}, "sgm.p1 is 8.5, allowed: whole numbers with census"),
    ("cost", {"window": 4}, "cost.window is 4, allowed: integer >= 3, <= 11, odd"),
    ("cost", {"windows": 5}, "unknown key 'cost.windows', did you mean window? (known: method, window)"),
    ("sgm", {"p1": 145}, "sgm: p1 145 is above p2 144, the penalty of a larger step"),
    ("sgm", {"p2": 8144}, "sgm.p2 is 8144, allowed: <= 8143 with cost.window 7, so that costs summed over"),
    ("sgm", [8, 32], "sgm is [8, 32], allowed: section of penalty, p1, p2, span or null"),
    ("ambiguity", {"eta_max": float("nan")}, "ambiguity.eta_max is NaN, allowed: number > 0, <= 1"),
    ("ambiguity", {"eta_step": 0.0001}, "ambiguity.eta_step is 0.0001, allowed: number >= 0.001, <= 1"),
    ("ambiguity", {"eta_step": 0.8}, "ambiguity: eta_step 0.8 is above eta_max 0.7"),
    ("ambiguity", {"p1": -1, "p99": 9}, "ambiguity.p1 is -1, allowed: number >= 0 or null"),
    ("ambiguity", {"p1": 9}, "ambiguity: p1 is 9.0, p99 is null: give both or none"),
    ("ambiguity", {"p1": 9, "p99": 1}, "ambiguity: p1 9.0 is above p99 1.0, swap them"),
    ("ambiguity", {"p1": 1, "p99": 9, "normalization": "range"}, "ambiguity: p1 and p99 are percentiles: leave them"),
    ("ambiguity", None, "regularization needs ambiguity, set to null: give ambiguity or set"),
    ("interval", {"alpha": "0.9"}, "interval.alpha is '0.9', allowed: number > 0, <= 1 or null"),
    ("interval", {"coverage": None}, "interval: alpha and coverage are null: give one of them, or set interval to"),
    ("cross_check", {"method": "slow"}, "cross_check.method is 'slow', allowed: fast or accurate"),
    ("tiles", {"size": 100}, "tiles.size is 100, allowed: integer >= 64, <= 16384, multiple of 64"),
    ("tiles", {"overlap": "none"}, "tiles.overlap is 'none', allowed: integer >= 1, <= 4096 or exact"),
    ("tiles", {"overlap": 2}, "tiles.overlap is 2, allowed: >= 4 with cost.window 7"),
    ("products", {"keep_rejected": 1}, "products.keep_rejected is 1, allowed: true or false"),
    ("regularisation", {}, "unknown key 'regularisation', did you mean regularization? (known: preset, disparity"),
    ("preset", "papr", "preset is 'papr', allowed: satellite or satellite-mccnn or paper or mccnn"),
    ("preset", ["paper"], "preset is ['paper'], allowed: satellite or"),
    ("sgm", {"p2": 40, "span": 9}, "sgm.span is given, but with cost.method census it follows from p2: leave it out"),
    (7, {}, "unknown key '7' (known: preset, disparity, rows, interval, cost"),
]


@pytest.mark.parametrize(("section", "keys", "expected"), REFUSED)
def test_load_config__refuses_with_key_value_and_what_is_allowed(section: Any, keys: Any, expected: str, write) -> None:
    given = RANGE | {section: RANGE["disparity"] | keys if section == "disparity" and keys else keys}
    assert message(given).startswith(expected)
    file = write(yaml.safe_dump(given))
    assert message(file).startswith(f"{file}: {expected}")


def test_load_config__a_file_is_not_blamed_for_overrides(write) -> None:
    file = write("tiles: {size: 1, overlap: 2}\n")
    assert message(file, RANGE | {"tiles": {"size": 2}}).startswith("tiles.size is 2, allowed:")
    assert message(file, RANGE).startswith(f"{file}: tiles.size is 1, allowed:")
    assert message(file, RANGE | {"tiles": {"size": 64}}).startswith(f"{file}: tiles.overlap is 2, allowed:")


def test_load_config__search_range_is_found_unless_it_is_given() -> None:
    assert load_config(None).disparity.is_auto
    assert not settings().disparity.is_auto
    assert message({"disparity": {"minimum": 0}}).startswith(
        "disparity: minimum is 0, maximum is auto: give two numbers"
    )
    assert message({"disparity": {"minimum": "low", "maximum": 3}}) == (
        "disparity.minimum is 'low', allowed: integer >= -16000, <= 16000 or auto"
    )


def test_load_config__tells_several_errors_in_one_line() -> None:
    assert message(RANGE | {"tiles": {"size": 1}, "median": {"size": 2}}) == (
        "median.size is 2, allowed: integer >= 3, <= 11, odd; "
        "tiles.size is 1, allowed: integer >= 64, <= 16384, multiple of 64"
    )


@pytest.mark.parametrize(("window", "largest"), [(3, 8183), (5, 8167), (7, 8143), (9, 8111), (11, 8071)])
def test_load_config__p2_is_held_to_what_16_bits_hold(window: int, largest: int) -> None:
    assert settings(cost={"window": window}, sgm={"p2": largest}).cost_span <= 65534
    assert f"allowed: <= {largest} with" in message(RANGE | {"cost": {"window": window}, "sgm": {"p2": largest + 1}})
    assert 8 * (window**2 - 1 + largest + 1) > 65534


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("disparity: {minimum: -60\ncost: [", "line 2: "),
        ("sgm: {p1: 1}\ntiles: {}\nsgm: {p1: 2}\n", "line 3: key 'sgm' appears twice"),
        ("sgm:\n  p1: 1\n  p1: 1\n", "line 3: key 'p1' appears twice"),
        ("a: 1\n---\nb: 2\n", "line 2: but found another document"),
        ("sgm: !!python/name:os.system\n", "line 1: could not determine a constructor"),
        ("sgm: *nowhere\n", "line 1: found undefined alias"),
        ("[1, 2]: 3\n", "line 1: found unhashable key"),
        ("- disparity\n", "holds ['disparity'], allowed: sections preset, disparity, rows"),
        ("paper", "holds 'paper', allowed: sections preset, disparity, rows"),
        ("sgm: {p1: 2024-13-45}\n", "month must be in 1..12"),
        (b"II*\x00\x08\x00\x00\x00", "unacceptable character"),
        (b"sgm: \xff\n", "unacceptable character"),
    ],
)
def test_load_config__unreadable_yaml_names_file_and_line(write, text: str | bytes, expected: str) -> None:
    file = write(text)
    assert message(file).startswith(f"{file}: {expected}")


def test_load_config__merged_keys_may_be_given_again(write) -> None:
    file = write("cross_check: &check {method: fast}\nrefinement: {<<: *check, method: least_squares}\n")
    assert load_config(file, RANGE) == settings()


def test_load_config__unreadable_file_is_named(tmp_path: Path) -> None:
    missing = tmp_path / "missing.yaml"
    assert message(missing) == f"{missing}: No such file or directory"
    preset = tmp_path / "mccnn.yaml"
    assert message(preset).endswith(
        "mccnn.yaml: No such file or directory (give --preset mccnn for the preset of the package)"
    )
    assert message(tmp_path) == f"{tmp_path}: Is a directory"


def test_load_config__refuses_other_sources() -> None:
    assert message([RANGE]).endswith("allowed: a YAML file, a mapping or a Config")


# --- thresholds


@pytest.mark.parametrize(
    ("window", "sgm", "span"),
    [(5, (8, 32), 448), (11, (20, 80), 1600), (5, None, 24)],
)
def test_cost_span__is_the_theoretical_one(window: int, sgm: tuple[int, int] | None, span: int) -> None:
    penalties = None if sgm is None else {"p1": sgm[0], "p2": sgm[1]}
    assert settings(cost={"window": window}, sgm=penalties).cost_span == span


@given(st.integers(1, 1000), st.sampled_from([3, 5, 7, 9, 11]), st.integers(1, 600))
def test_cut_level__is_the_floor_of_the_written_decimal(thousandths: int, window: int, p2: int) -> None:
    config = settings(interval={"alpha": thousandths / 1000}, cost={"window": window}, sgm={"p1": 1, "p2": p2})
    assert config.cut_level == (1000 - thousandths) * config.cost_span // 1000


@given(st.integers(1, 100), st.integers(1, 100))
def test_ambiguity_levels__stay_below_eta_max(maximum: int, step: int) -> None:
    maximum, step = max(maximum, step), min(maximum, step)
    config = settings(ambiguity={"eta_max": maximum / 100, "eta_step": step / 100})
    assert config.ambiguity_levels == tuple(hundredths * 1536 // 100 for hundredths in range(0, maximum, step))


@given(
    eta_max=st.decimals("0.01", 1, places=2),
    eta_step=st.decimals("0.01", 1, places=2),
    window=st.sampled_from([3, 5, 7]),
    sgm=st.none() | st.builds(Sgm, p1=st.just(1), p2=st.integers(1, 40)),
)
def test_ambiguity_weights__count_the_etas_that_reach_a_cost(
    eta_max: Decimal, eta_step: Decimal, window: int, sgm: Sgm | None
) -> None:
    eta_max, eta_step = max(eta_max, eta_step), min(eta_max, eta_step)
    config = Config(
        disparity=Disparity(minimum=0, maximum=1),
        cost=Census(window=window),
        sgm=sgm,
        ambiguity=Ambiguity(eta_max=eta_max, eta_step=eta_step),
    )
    weights = config.ambiguity_weights
    assert weights is not None
    assert weights.dtype == np.uint16
    etas = [i * eta_step for i in range(101) if i * eta_step < eta_max]
    span = config.cost_span
    assert weights.tolist() == [sum(above <= eta * span for eta in etas) for above in range(span + 1)]


def test_thresholds__are_none_where_their_step_is_off() -> None:
    config = settings(ambiguity=None, interval=None, regularization=None)
    assert config.cut_level is None
    assert config.ambiguity_levels is None
    assert config.ambiguity_weights is None
