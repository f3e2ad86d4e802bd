"""What steps of a run hand to later ones: a folder, one form of files, a manifest, and tiles. Only here is fsspec."""
