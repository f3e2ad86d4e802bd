"""The method's inner loops: arrays in, arrays out. The only home of numba."""
