"""Tiles between the two stages of a run: manifest, records and arrays. The only home of zarr and fsspec."""
