"""Settings that `calibrate --tune` compares: presets, and ladders of penalties."""

from collections.abc import Iterator, Mapping
from typing import Any

from sat_intervals.config import PRESETS, Config, key_of, load_config
from sat_intervals.errors import SatIntervalsError

_CENSUS = {5: ((8, 64), (12, 64), (16, 128)), 7: ((8, 64), (32, 256)), 11: ((50, 350),)}
_COSINE = ((0.5, 3.0, 40.0), (0.7, 4.0, 45.0), (1.0, 6.0, 60.0))


def candidates(own: Config, *, with_network: bool) -> Iterator[tuple[str, dict[str, Any] | None]]:
    """Yield names and settings: own ones (None) if they are none of the others, presets, and ladders of penalties."""
    changes = dict(_ladder(with_network=with_network))
    if not any(_is_same(own, one) for one in changes.values()):
        yield "own settings", None
    yield from changes.items()


def _is_same(own: Config, changes: Mapping[str, Any]) -> bool:
    """Return whether changes leave the key of settings as it is; no, if the settings do not allow them."""
    try:
        return key_of(changed(own, changes)) == key_of(own)
    except SatIntervalsError:
        return False


def _ladder(*, with_network: bool) -> Iterator[tuple[str, dict[str, Any]]]:
    for preset in PRESETS:
        if with_network or "mccnn" not in preset:
            yield preset, {"preset": preset}
    for window, penalties in _CENSUS.items():
        for p1, p2 in penalties:
            yield f"census {window}, {p1}/{p2}", {"cost": {"window": window}, "sgm": {"p1": p1, "p2": p2}}
    for lower, upper, span in _COSINE if with_network else ():
        sgm = {"penalty": "constant", "p1": lower, "p2": upper, "span": span}
        yield f"mccnn, {lower:g}/{upper:g}", {"preset": "satellite-mccnn", "sgm": sgm}


def changed(config: Config, changes: Mapping[str, Any] | None) -> Config:
    """Return the settings that are compared, with search range, cross-checking, tiles and cluster of the others."""
    if changes is None:
        return config
    kept = config.model_dump(include={"disparity", "cross_check", "tiles", "cluster"})
    return load_config(changes, kept)
