"""How many simulated shifts the deviations of `register` hold at .9, by kind of ground and of noise.

usage: python tests/benchmarks/registration.py [SEEDS]
"""

import itertools
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "kernels"))
from test_registration import errors_and_deviations, hills, houses, mountains

NOISE, WIDE, SHIFTS = (0.1, 0.5, 1.0), (1, 3), (0, 0.25, 1.5, 3.7)


def main(seeds: int) -> None:
    for heights_at in (houses, hills, mountains):
        for noise, wide in itertools.product(NOISE, WIDE):
            kinds = seeds * list(itertools.product([noise], [wide], SHIFTS, [True, False]))
            errors, deviations = errors_and_deviations(heights_at, kinds)
            inside, size = (np.abs(errors) <= 1.645 * deviations).mean(), np.sqrt((errors**2).mean())
            print(f"{heights_at.__name__:10} noise {noise} m {wide} wide: inside {inside:.3f}, error {size:.3f} cells")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 6)
