"""Measure vertical parallax and noise of a pair at sample blocks."""

from operator import itemgetter

from sat_intervals.errors import InputError
from sat_intervals.match.rows import Survey
from sat_intervals.match.sampling import Look, Spot, look, spots
from sat_intervals.match.search_range import settings
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.prepare.pair import Each, Pair
from sat_intervals.tiling import Window


def measured_parallax(pair: Pair, region: Window, search: tuple[int, int], each: Each) -> Survey:
    """Look at blocks of a region of the left image over a search range: noise and row offsets."""
    compile_kernels(settings(0, 3), hands_states_on=False)
    chosen = [(pair, spot) for spot in spots(region, *search)]
    found = sorted(each(look_at, chosen, "rows"), key=itemgetter(0))
    return Survey.of_looks(region, search, [one for _, one in found if one is not None], pair.shapes[1])


def look_at(pair: Pair, spot: Spot) -> Look | None:
    """Look at a block, None where it cannot be read: its tiles will say so; runs on a worker."""
    try:
        left, right = (pair.view(side, window) for side, window in enumerate(spot.views))
    except InputError:
        return None
    return look(spot, left, right)
