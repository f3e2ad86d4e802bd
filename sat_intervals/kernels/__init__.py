"""The method's inner loops: arrays in, arrays out. The only home of numba.

Letters of all modules: r row, c column, k disparity index (disparity = minimum + k). Others are named in each.
"""

from sat_intervals.kernels.compiled import FINGERPRINT

__all__ = ["FINGERPRINT"]
