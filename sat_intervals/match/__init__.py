"""The method on one patch: arrays in, raw products and final bands out. No files, no scheduler."""
