"""True errors behind errors that were measured with noise: conformal prediction under label noise.

Einbinder et al. (2024) show that noise of references widens margins. Here its distribution is known, so it is taken
out: errors, in half widths, are a mixture of normal distributions about 0, to whose variances noise adds its own. The
shares of the most likely mixture (Kiefer and Wolfowitz 1956) are found by expectation maximisation.
"""

from math import erf, sqrt
from typing import NamedTuple

import numpy as np

# Standard deviations of the mixture in half widths; steps towards its shares: more of them fit the noise.
_SCALES = np.geomspace(0.02, 60, 28)
_STEPS = 300
MOST = 2048  # errors that are used


class TrueErrors(NamedTuple):
    """Distribution of true errors in half widths: shares of normal distributions ``(28,)``."""

    shares: np.ndarray

    def within(self, factor: float) -> float:
        """Return the share of errors of at most so many half widths."""
        return float(self.shares @ [erf(factor / (sqrt(2) * scale)) for scale in _SCALES])

    def factor(self, coverage: float) -> float:
        """Return the number of half widths that a share of the errors does not exceed."""
        low, high = 0.0, 10 * float(_SCALES[-1])
        while high - low > 1e-4:
            middle = (low + high) / 2
            low, high = (middle, high) if self.within(middle) < coverage else (low, middle)
        return high


def true_errors(errors: np.ndarray, noise: np.ndarray) -> TrueErrors:
    """Return the distribution of true errors from measured ones and deviations of their noise: ``(n,)``."""
    every = slice(None, None, -(-errors.size // MOST))
    deviation = np.hypot(_SCALES, noise[every, np.newaxis])
    likelihood = np.exp(-0.5 * np.square(errors[every, np.newaxis] / deviation)) / deviation
    likelihood = np.maximum(likelihood, 1e-300)
    shares = np.full(_SCALES.size, 1 / _SCALES.size)
    for _ in range(_STEPS):
        parts = likelihood * shares
        shares = (parts / parts.sum(axis=1, keepdims=True)).mean(axis=0)
    return TrueErrors(shares)
