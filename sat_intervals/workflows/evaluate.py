"""Evaluate runs, and pairs that are matched first, against the truth of their left images."""

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from sat_intervals.config import Config, load_config
from sat_intervals.config.pairs import Pair, group_beside
from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.disparity import evaluate_run
from sat_intervals.evaluate.paper import SceneMetrics
from sat_intervals.raster import path_of
from sat_intervals.results import open_run
from sat_intervals.run.pair import match_pair
from sat_intervals.workflows.sources import Source, find_sources

_LOG = logging.getLogger(__name__)


def evaluate_scenes(
    paths: Sequence[Path],
    config: Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    *,
    truths: Sequence[Path] = (),
    masks: Sequence[Path] = (),
    group: str | None = None,
    on_match: Callable[[str], None] = lambda name: None,
    **how: Any,
) -> list[SceneMetrics]:
    """Evaluate runs and pairs, in their order.

    Pairs are matched with ``config`` and ``overrides``, as in `match_batch`; ``on_match`` is called with their names
    before. ``group`` replaces the groups in the files. ``how`` are further arguments of `evaluate_run`.
    """
    sources = find_sources(paths, truths, masks)
    configs = {source.name: _config(source.pair, config, overrides) for source in sources if source.pair}
    scenes = []
    for source in sources:
        if source.pair:
            on_match(source.name)
            report = _matched(source, source.pair, configs[source.name], **how)
            of = source.pair.group
        else:
            report = evaluate_run(source.name, source.truth, source.mask, **how)
            of = group or group_beside(path_of(open_run(source.name).report["inputs"]["left"]["path"]))
        scenes.append(SceneMetrics(source.name, group or of, report))
    return scenes


def _config(pair: Pair, config: Path | None, overrides: Mapping[str, Any] | None) -> Config:
    sections = {"disparity": {"minimum": pair.minimum, "maximum": pair.maximum}, "products": {"keep_rejected": True}}
    settings = load_config(load_config(config, overrides), sections)
    if settings.interval is None:
        place = f"{config}: " if config else ""
        raise SatIntervalsError(f"{place}interval is null, but evaluate needs intervals: leave it on")
    return settings


def _matched(source: Source, pair: Pair, config: Config, **how: Any) -> dict[str, Any]:
    """Match a pair to files that are deleted, and evaluate it."""
    with TemporaryDirectory(prefix="sat-intervals-") as out:
        for line in match_pair(pair.left, pair.right, out, config)["warnings"]:
            _LOG.warning("%s", line)
        return evaluate_run(out, source.truth, source.mask, **how)
