"""The method's inner loops: arrays in, arrays out. The only home of numba."""

from sat_intervals.kernels.compiled import FINGERPRINT

__all__ = ["FINGERPRINT"]
