"""The matching costs that there are."""

from sat_intervals.config import Config
from sat_intervals.match.census import CensusCost
from sat_intervals.match.matching_cost import Given, MatchingCost
from sat_intervals.match.mccnn import MccnnCost
from sat_intervals.match.sweep import SweepCost
from sat_intervals.match.volume import VolumeCost

_COSTS: dict[str, type[MatchingCost]] = {
    "census": CensusCost,
    "mccnn": MccnnCost,
    "volume": VolumeCost,
    "sweep": SweepCost,
}


def cost_of(config: Config, given: Given | None = None) -> MatchingCost:
    """Return the matching cost of settings, with all that it needs."""
    return _COSTS[config.cost.method](config, given or Given())


def check_cost(config: Config) -> None:
    """Raise if the matching cost of settings cannot be computed on this machine."""
    _COSTS[config.cost.method].check(config)
