"""Row offsets fitted to sample blocks of a pair."""

import json
import re

import numpy as np
import pytest

from sat_intervals import SatIntervalsError
from sat_intervals.match.parallax import Survey, fit_rows
from sat_intervals.match.sampling import BlockMatch
from sat_intervals.run.quality import rows_left
from sat_intervals.tiling import Window


def samples_at(function, count=25, side=1000, wrong=0, noise=0.0, seed=0):
    """Sample blocks spread over an image, at offsets of a function of row and column; some are wrong by pixels."""
    random = np.random.default_rng(seed)
    row, column = np.mgrid[0 : side - 1 : 5j, 0 : side - 1 : 5j].reshape(2, -1)[:, :count]
    offset = function(row, column) + noise * random.normal(size=row.size)
    offset[random.permutation(row.size)[:wrong]] += 3
    return [BlockMatch(r, c, 1000, 0.8, 5.0, 12.0, float(rows)) for r, c, rows in zip(row, column, offset, strict=True)]


def test_fit_rows__finds_a_plane_beside_wrong_looks():
    fit = fit_rows(samples_at(lambda r, c: 2 + 0.001 * r - 0.0005 * c, wrong=4, noise=0.02), 1000, 1000)
    assert len(fit.offsets.coefficients) == 3
    for row, column in ((0, 0), (0, 999), (999, 0), (999, 999)):
        assert abs(fit.offsets.at(np.array(row), np.array(column)) - (2 + 0.001 * row - 0.0005 * column)) < 0.05
    assert fit.most == pytest.approx(3.0, abs=0.05)
    assert fit.matches == 25_000
    assert not fit.has_jitter


def test_fit_rows__takes_the_lowest_degree_that_explains_the_looks():
    assert len(fit_rows(samples_at(lambda r, c: 1 + 0 * r, noise=0.02), 1000, 1000).offsets.coefficients) == 1
    bent = fit_rows(samples_at(lambda r, c: 4e-6 * (r - 500) ** 2, noise=0.01), 1000, 1000)
    assert len(bent.offsets.coefficients) == 6


def test_fit_rows__rows_that_jump_are_jitter():
    fit = fit_rows(samples_at(lambda r, c: np.where((r // 200) % 2 == 0, 0.4, -0.4)), 1000, 1000)
    assert fit.has_jitter


def test_survey__refuses_pairs_that_are_not_epipolar():
    random = np.random.default_rng(1)
    for function in (lambda r, c: random.uniform(-8, 8, r.shape), lambda r, c: 14 + 0 * r):
        survey = survey_of(samples_at(function))
        with pytest.raises(SatIntervalsError, match=r"not an epipolar pair: rows differ by .* px in the median"):
            survey.taken("auto")
        assert survey.taken("none") is None


@pytest.mark.parametrize("noise", [0.8, 1.3, 1.8])
def test_fit_rows__blocks_that_scatter_get_a_constant_and_a_warning(noise):
    for seed in range(8):
        survey = survey_of(samples_at(lambda r, c: -1.4 + 0 * r, wrong=2, noise=noise, seed=seed))
        (constant,) = survey.taken("auto").coefficients
        assert abs(constant + 1.4) < 0.6 * noise
        (line,) = rows_left(survey, "auto", "right.tif")
        assert f"a constant leaves {survey.rows.after[0]:.2f} px of row offset in the median" in line


def test_fit_rows__sample_blocks_that_hardly_match_are_not_taken_out():
    samples = samples_at(lambda r, c: 0.9 + 0 * r, noise=0.02)
    poor = [
        sample._replace(share=0.58, rows=sample.rows + 9 * (-1) ** place) for place, sample in enumerate(samples[5:])
    ]
    assert fit_rows([*samples[:5], *poor], 1000, 1000).offsets.coefficients[0] == pytest.approx(0.9, abs=0.03)
    assert fit_rows([*samples[:2], *poor], 1000, 1000) is None
    alone = survey_of([sample._replace(share=0.5) for sample in samples])
    assert alone.rows.before[0] == pytest.approx(0.9, abs=0.03)
    assert alone.taken("auto") is None


def test_contradiction__names_no_median_above_the_maximum():
    values = [8.1, 8.2, -8.0, -8.3, 0.1, 8.4, -8.2, 8.0]
    samples = [sample._replace(rows=rows) for sample, rows in zip(samples_at(lambda r, c: 0 * r), values, strict=False)]
    line = fit_rows(samples, 1000, 1000).contradiction
    median, most = map(float, re.search(r"differ by (\S+) px in the median, at most (\S+),", line).groups())
    assert (median, most) == (8.2, 8.4)


def survey_of(samples, side=1000, columns=1000):
    return Survey(Window(0, 0, side, side), (-9, 9), 0.5, fit_rows(samples, columns, columns))


def test_survey__takes_out_what_is_large_enough():
    for size, taken in ((0.2, False), (0.5, True)):
        survey = survey_of(samples_at(lambda r, c, size=size: size + 0 * r))
        assert (survey.taken("auto") is not None) == taken
        assert survey.taken("none") is None
        assert Survey.of_report(json.loads(json.dumps(survey.report()))) == survey
    nothing = survey_of(samples_at(lambda r, c: 0 * r, count=2))
    assert (nothing.rows, nothing.taken("auto")) == (None, None)


def test_fit_rows__does_not_judge_places_far_from_the_sample_blocks():
    """A small region of a large image, whose plane reaches many pixels elsewhere."""
    near = [
        sample._replace(row=sample.row / 4, column=sample.column / 4)
        for sample in samples_at(lambda r, c: 0.002 * (r - c))
    ]
    survey = survey_of(near, 250, 20_000)
    assert survey.rows.most < 5
    assert survey.taken("auto") is not None
