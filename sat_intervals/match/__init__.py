"""The method on one patch: from arrays to raw products and final bands, without files or scheduler."""
