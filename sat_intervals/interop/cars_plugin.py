"""Register our method with CARS, which imports this module through the entry point group ``cars.plugins``."""

import warnings

try:
    from sat_intervals.interop.cars_method import SatIntervals as SatIntervals
except ImportError as error:  # another version of CARS must still work, without our method
    warnings.warn(f"sat_intervals needs CARS 1.3 and cannot be used with this version: {error}", stacklevel=2)
