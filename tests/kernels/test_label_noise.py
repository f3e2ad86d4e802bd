"""True errors behind noisy ones."""

import numpy as np
import pytest

from sat_intervals.kernels.label_noise import true_errors


@pytest.mark.parametrize("noise", [0.0, 0.5, 1.0])
def test_true_errors__are_those_without_the_noise(noise):
    random = np.random.default_rng(0)
    errors = random.standard_t(3, 4000)
    found = true_errors(errors + random.normal(0, noise, errors.size), np.full(errors.size, noise))
    for factor in (1.0, 2.0, 4.0):
        assert found.within(factor) == pytest.approx((abs(errors) <= factor).mean(), abs=0.03)
    assert found.within(found.factor(0.9)) == pytest.approx(0.9, abs=1e-3)


def test_true_errors__hundred_noisy_points_reach_the_coverage_in_most_draws():
    # Noise is as large as the errors, of points with narrow and with wide intervals.
    reached = []
    for seed in range(60):
        random = np.random.default_rng(seed)
        errors, noise = random.standard_t(3, 100), random.choice([0.3, 1.0, 3.0], 100)
        factor = true_errors(errors + random.normal(0, noise), noise).factor(0.91)
        reached.append((abs(random.standard_t(3, 20_000)) <= factor).mean())
    assert np.mean(reached) == pytest.approx(0.9, abs=0.02)
    assert np.quantile(reached, 0.05) > 0.82
