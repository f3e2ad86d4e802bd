"""Read and write GeoTIFF: images, their georeferencing, and the files of a run. Only this folder imports rasterio."""

from sat_intervals.errors import InputError
from sat_intervals.raster.beside import check_place
from sat_intervals.raster.blocks import BLOCK, codec_versions, compressed, factors
from sat_intervals.raster.cog import Part
from sat_intervals.raster.dependencies import other_files, pixel_files, read_files, survey, watched_rasters
from sat_intervals.raster.files import POINT_FILES, RUN_FILES, File, ranges_file, run_files, surface_file, truth_file
from sat_intervals.raster.footprint import footprint
from sat_intervals.raster.frame import Frame, Vertical
from sat_intervals.raster.georeferencing import ControlPoint, Georeferencing
from sat_intervals.raster.heightfield import GROUND, HeightRaster
from sat_intervals.raster.hidden import remove_scratch, replaceable, restore
from sat_intervals.raster.images import Image, check_as_opened, check_pair, open_image, watched_images
from sat_intervals.raster.layers import (
    MARK,
    check_as_made,
    check_made_by,
    check_marked,
    north_up,
    put_back,
    read_alone,
    read_known,
    read_layers,
    read_shape,
    read_tags,
    write_file,
    write_layer,
    write_once,
)
from sat_intervals.raster.old_publishing import OutputError, examined, stamps
from sat_intervals.raster.overviews import read_small_image, read_small_layers
from sat_intervals.raster.projection import Projection, geoid_grid, grid_mapping, utm_of
from sat_intervals.raster.space import check_space, file_bytes, part_bytes
from sat_intervals.raster.surfaces import (
    check_reference,
    covered_window,
    is_surface,
    read_heights,
    read_place,
    resolution_of,
)
from sat_intervals.raster.windows import Layer, read_views, read_window
from sat_intervals.raster.writer import OutputWriter

__all__ = [
    "BLOCK",
    "GROUND",
    "MARK",
    "POINT_FILES",
    "RUN_FILES",
    "ControlPoint",
    "File",
    "Frame",
    "Georeferencing",
    "HeightRaster",
    "Image",
    "InputError",
    "Layer",
    "OutputError",
    "OutputWriter",
    "Part",
    "Projection",
    "Vertical",
    "check_as_made",
    "check_as_opened",
    "check_made_by",
    "check_marked",
    "check_pair",
    "check_place",
    "check_reference",
    "check_space",
    "codec_versions",
    "compressed",
    "covered_window",
    "examined",
    "factors",
    "file_bytes",
    "footprint",
    "geoid_grid",
    "grid_mapping",
    "is_surface",
    "north_up",
    "open_image",
    "other_files",
    "part_bytes",
    "pixel_files",
    "put_back",
    "ranges_file",
    "read_alone",
    "read_files",
    "read_heights",
    "read_known",
    "read_layers",
    "read_place",
    "read_shape",
    "read_small_image",
    "read_small_layers",
    "read_tags",
    "read_views",
    "read_window",
    "remove_scratch",
    "replaceable",
    "resolution_of",
    "restore",
    "run_files",
    "stamps",
    "surface_file",
    "survey",
    "truth_file",
    "utm_of",
    "watched_images",
    "watched_rasters",
    "write_file",
    "write_layer",
    "write_once",
]
