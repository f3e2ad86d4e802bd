"""What CARS loads whenever it is imported, by the entry point group ``cars.plugins``: it registers our method."""

import warnings

try:
    from sat_intervals.interop.cars_method import SatIntervals as SatIntervals
except ImportError as error:  # of another CARS than the extra [cars] names, which must go on without us
    warnings.warn(f"this CARS cannot match with sat_intervals, which needs CARS 1.3: {error}", stacklevel=2)
