"""What decides the bytes of a run beside its settings and images: found once, before the tiles of a pair."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Generic, TypeVar

from sat_intervals.config import Config, resolved
from sat_intervals.errors import InputError, SatIntervalsError
from sat_intervals.kernels.row_offsets import RowOffsets
from sat_intervals.match.around import with_hull
from sat_intervals.match.coarse import Found, settings, with_range
from sat_intervals.match.ground import GroundViews
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.normalization import Moments, PairStatistics, blocks, moments, statistics_of
from sat_intervals.match.parallax import Survey, fit_rows
from sat_intervals.match.sampling import BlockMatch, SampleBlock, block_match, noise_of, sample_blocks
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.prepare.pair import ArrayPair, Each, FilePair, Pair, here
from sat_intervals.prepare.search_range import found_range
from sat_intervals.products import plain
from sat_intervals.tiling import Window

P = TypeVar("P", FilePair, ArrayPair)


@dataclass(frozen=True)
class Prepared(Generic[P]):
    """A pair, ready for its tiles.

    pair: with the row offsets taken out of the right image.
    config: settings with the search range as numbers.
    search, survey: evidence of the search range, None if it is given, and of noise and vertical parallax.
    rows: what was taken out.
    ranges: local search ranges.
    statistics: of the whole images; None if the matching cost needs none.
    missed: see `Survey.missed`.
    ground: where many images show the ground; None of a pair.
    """

    pair: P
    config: Config
    search: Found | None
    survey: Survey | None
    rows: RowOffsets | None
    ranges: LocalRanges | None
    statistics: PairStatistics | None
    missed: str = ""
    ground: GroundViews | None = None

    def known(self) -> dict[str, Any]:
        """Return what `prepare` takes as known of the same images."""
        statistics = self.statistics and {"rows": plain(self.rows and asdict(self.rows)), **self.statistics.report()}
        return {
            "found": self.search and self.search.report(),
            "survey": self.survey and self.survey.report(),
            "statistics": statistics,
        }


def prepare(
    pair: P,
    config: Config,
    each: Each = here,
    *,
    region: Window | None = None,
    known: Mapping[str, Any] | None = None,
    measures_rows: bool = True,
) -> Prepared[P]:
    """Find what the settings leave open.

    ``region`` of the left image is matched, by default all; search ranges and statistics are always those of the whole
    images. ``known`` is from `Prepared.known` of the same images. ``measures_rows``: also where ``rows`` is none.
    """
    config, known = resolved(config), known or {}
    whole = Window(0, 0, *pair.shapes[0])
    config, search, ranges = _searched(pair, config, each, known)
    (left, right), widths = pair.names, [columns for _, columns in pair.shapes]
    config.disparity.check_images(left, widths[0], right, widths[1])
    survey = _surveyed(pair, config, each, region or whole, known) if measures_rows or config.rows == "auto" else None
    missed = ""
    if survey and not search and region in (None, whole):
        missed = survey.missed(lambda: found_range(pair, each))
    try:
        rows = survey.taken(config.rows, missed) if survey else None
    except SatIntervalsError as error:
        raise SatIntervalsError(f"{left} and {right}: {error}") from None
    pair = pair.with_rows(rows)
    statistics = _measured(pair, rows, each, known) if config.cost.needs_statistics else None
    return Prepared(pair, config, search, survey, rows, ranges, statistics, missed)


def _searched(
    pair: Pair, config: Config, each: Each, known: Mapping[str, Any]
) -> tuple[Config, Found | None, LocalRanges | None]:
    """Return settings with the search range as numbers, what was found if needed, and local ranges, if any."""
    search = config.disparity
    found = None
    local = None
    if given := pair.given_ranges(search):
        local, source = given
        config = with_hull(config, local, source) if search.is_auto else config
    elif search.is_auto or search.local:
        found = Found.of_report(known["found"]) if known.get("found") else found_range(pair, each)
        local = found.local if search.local else None
        config = with_range(config, found) if search.is_auto else config
    return config, found, local and local.clipped(config.disparity.minimum, config.disparity.maximum)


def _surveyed(pair: Pair, config: Config, each: Each, region: Window, known: Mapping[str, Any]) -> Survey:
    search = config.disparity.minimum, config.disparity.maximum
    if known.get("survey"):
        survey = Survey.of_report(known["survey"])
        if (survey.region, survey.search) == (region, search):
            return survey
    return measured_parallax(pair, region, search, each)


def measured_parallax(pair: Pair, region: Window, search: tuple[int, int], each: Each) -> Survey:
    """Measure noise and row offsets of a pair at blocks of a region of the left image, over a search range."""
    compile_kernels(settings(0, 3), hands_states_on=False)
    blocks = [(pair, sample) for sample in sample_blocks(region, *search)]
    found = dict(each(match_at, blocks, "rows"))
    samples = [found[number] for number in range(len(blocks)) if found[number] is not None]
    return Survey(region, search, noise_of(samples), fit_rows(samples, *pair.shapes[1]))


def match_at(pair: Pair, sample: SampleBlock) -> BlockMatch | None:
    """Match a block; None where it cannot be read: its tiles will say so. Runs on a worker."""
    try:
        left, right = (pair.view(side, window) for side, window in enumerate(sample.views))
    except InputError:
        return None
    return block_match(sample, left, right)


def _measured(pair: Pair, rows: RowOffsets | None, each: Each, known: Mapping[str, Any]) -> PairStatistics:
    """Return mean and standard deviation of both images."""
    before = known.get("statistics")
    if before and before["rows"] == plain(rows and asdict(rows)):
        return PairStatistics.of_report(before)

    def of_side(side: int) -> Iterator[Moments]:
        windows = blocks(*pair.shapes[side])
        found = dict(each(measure_block, [(pair, side, window) for window in windows], "images"))
        return (found[number] for number in range(len(windows)))

    return PairStatistics(statistics_of(of_side(0)), statistics_of(of_side(1)))


def measure_block(pair: Pair, side: int, block: Window) -> Moments:
    """Return the moments of a block of an image; runs on a worker."""
    _, pixels, state = pair.view(side, block)
    return moments(pixels, state)
