"""Scenes with a known truth: finished runs, and pairs that are matched first."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sat_intervals.config.pairs import Pair, check_names, find_pairs, is_pair
from sat_intervals.errors import SatIntervalsError


@dataclass(frozen=True)
class Source:
    """A finished run, or a pair to match first; its truth, which a run may lack, and the mask given for it."""

    name: str
    pair: Pair | None
    truth: Path | None
    mask: Path | None


def find_sources(paths: Sequence[Path], truths: Sequence[Path], masks: Sequence[Path] = ()) -> list[Source]:
    """Return the runs and pairs of paths, in their order; truths and masks are given for all of them or for none."""
    found: list[tuple[str, Pair | None]] = []
    for path in paths:
        if (path / "run.json").exists():
            found.append((str(path), None))
        elif is_pair(path):
            found += [(pair.name, pair) for pair in find_pairs([path])]
        else:
            raise SatIntervalsError(
                f"{path} is neither a pair nor a finished run: give a folder with left.tif, right.tif, truth.tif and "
                "meta.json, a CSV, YAML or JSON file of pairs, or the folder of a run"
            )
    check_names(name for name, _ in found)
    for option, given in (("--truth", truths), ("--mask", masks)):
        if len(given) not in (0, len(found)):
            raise SatIntervalsError(
                f"{option} is given {len(given)} times for {len(found)} runs and pairs: give it once for each"
            )
    absent = (None,) * len(found)
    return [
        Source(name, pair, truth or (pair.truth if pair else None), mask)
        for (name, pair), truth, mask in zip(found, truths or absent, masks or absent, strict=True)
    ]
