"""Intermediate tile products: manifest, records and arrays. Only this folder imports zarr and fsspec."""
