"""Measure vertical parallax and noise of a pair at sample blocks."""

from operator import itemgetter

from sat_intervals.errors import InputError
from sat_intervals.match.coarse import settings
from sat_intervals.match.parallax import Survey
from sat_intervals.match.sampling import BlockMatch, SampleBlock, block_match, sample_blocks
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.prepare.pair import Each, Pair
from sat_intervals.tiling import Window


def measured_parallax(pair: Pair, region: Window, search: tuple[int, int], each: Each) -> Survey:
    """BlockMatch at blocks of a region of the left image over a search range: noise and row offsets."""
    compile_kernels(settings(0, 3), hands_states_on=False)
    chosen = [(pair, sample) for sample in sample_blocks(region, *search)]
    found = sorted(each(match_at, chosen, "rows"), key=itemgetter(0))
    return Survey.of_matches(region, search, [one for _, one in found if one is not None], pair.shapes[1])


def match_at(pair: Pair, sample: SampleBlock) -> BlockMatch | None:
    """BlockMatch at a block, None where it cannot be read: its tiles will say so; runs on a worker."""
    try:
        left, right = (pair.view(side, window) for side, window in enumerate(sample.views))
    except InputError:
        return None
    return block_match(sample, left, right)
