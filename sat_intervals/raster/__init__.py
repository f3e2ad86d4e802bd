"""Read and write GeoTIFF: images, their georeferencing, and the files of a run. Only this folder imports rasterio."""

from sat_intervals.products import as_json
from sat_intervals.raster.blocks import BLOCK, codec_versions, compressed, factors, halved
from sat_intervals.raster.cog import Part
from sat_intervals.raster.files import RUN_FILES, File, points_file, ranges_file, run_files, surface_file, truth_file
from sat_intervals.raster.georeferencing import Georeferencing, between_180, footprint
from sat_intervals.raster.heightfield import GROUND, HeightRaster, is_ground
from sat_intervals.raster.identity import check_not_replaced, files_of
from sat_intervals.raster.images import Image, acquired, check_pair, describe, open_image
from sat_intervals.raster.layers import north_up, read_known, read_layers, read_shape, read_tags, write_layer
from sat_intervals.raster.projection import Frame, Projection, Vertical, utm_of
from sat_intervals.raster.publishing import OutputError, check_free, check_space, file_bytes, new_file, part_bytes
from sat_intervals.raster.rpc import find_model, fitted_rpc, read_rpc_file
from sat_intervals.raster.surfaces import ground_of, read_heights, read_place, surface_place
from sat_intervals.raster.windows import (
    Layer,
    read_reduced,
    read_reduced_views,
    read_small_layers,
    read_views,
    read_window,
)
from sat_intervals.raster.writer import OutputWriter
from sat_intervals.store.remote import RemotePath, path_of

__all__ = [
    "BLOCK", "GROUND", "RUN_FILES", "File", "Frame", "Georeferencing", "HeightRaster", "Image", "Layer",
    "OutputError", "OutputWriter", "Part", "Projection", "RemotePath", "Vertical", "acquired", "as_json",
    "between_180", "check_free", "check_not_replaced", "check_pair", "check_space", "codec_versions", "compressed",
    "describe", "factors", "file_bytes", "files_of", "find_model", "fitted_rpc", "footprint", "ground_of", "halved",
    "is_ground", "new_file", "north_up", "open_image", "part_bytes", "path_of", "points_file", "ranges_file",
    "read_heights", "read_known", "read_layers", "read_place", "read_reduced", "read_reduced_views",
    "read_rpc_file", "read_shape", "read_small_layers", "read_tags", "read_views", "read_window", "run_files",
    "surface_file", "surface_place", "truth_file", "utm_of", "write_layer",
]  # fmt: skip
