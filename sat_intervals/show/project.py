"""Write a QGIS project of a finished run, with the default styles of its rasters. QGIS is not needed."""

import os
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import BANDS, POINTS, SURFACE
from sat_intervals.raster import (
    Georeferencing,
    is_surface,
    open_image,
    read_layers,
    read_place,
    read_shape,
    read_small_image,
    read_small_layers,
)
from sat_intervals.raster.published import is_points_of, is_surface_of
from sat_intervals.raster.publishing import write_file
from sat_intervals.results import Run, open_input, open_run
from sat_intervals.show import styles
from sat_intervals.tiling import Window

# Longest side in pixels of what percentiles are taken from.
_LONGEST = 1024
_MULTIPLY = 6  # QGIS' blend mode
_CHECKED = "Qt::Checked"
# Names of rasters with a default style.
_STYLED = "intervals", "width", "validity", "points", "dsm", "dsm_half_width"


@dataclass(frozen=True)
class Layer:
    """A layer of the project: group, name and meaning in the list, a file or GDAL name, place and size, and colours.

    ``is_default``: the raster alone gets this style, too; ``blend`` is QGIS' mode over the layers below.
    """

    group: str
    name: str
    meaning: str
    source: str | Path
    place: Georeferencing
    shape: tuple[int, int]
    renderer: Element
    is_default: bool = False
    is_shown: bool = False
    blend: int = 0


@dataclass(frozen=True)
class Written:
    """The contents of the files that were written, and lines about what was left out."""

    files: dict[Path, bytes]
    notes: list[str]


def write_project(out: str | Path) -> Written:
    """Write ``project.qgz`` to the folder of a finished run, and the default styles of its rasters.

    The project has the images and the truth, disparity, interval width, confidence and validity; if ``points.tif`` and
    ``dsm.tif`` are of this run, also their heights. Paths in it are relative where the files are local.
    """
    run = open_run(out)
    file = run.out / "project.qgz"
    run.check_kept([file, *(run.out / f"{name}{end}" for name in _STYLED for end in (".qml", ".vrt"))])
    written = Written({}, [])
    layers = [*_surface(run, written), *_points(run, written), *_results(run, written)]
    for layer in layers:
        if layer.is_default:
            written.files[run.out / f"{Path(layer.source).stem}.qml"] = styles.default_style(layer.renderer)
    layers += _images(run, written)
    content = BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(zipfile.ZipInfo("project.qgs"), styles.text_of(_project(run, layers), styles.HEAD))
    written.files[file] = content.getvalue()
    for path, text in written.files.items():
        write_file(path, text)
    return written


def _results(run: Run, written: Written) -> Iterator[Layer]:
    file, group = run.out / "intervals.tif", "Disparity"
    place = run.georeferencing
    disparity, lower, upper, _ = read_small_layers(file, _fitting(run.shape))
    counts = np.zeros(1 << 16, np.int64)
    for window in run.windows():
        counts += np.bincount(read_layers(run.out / "validity.tif", window).ravel(), minlength=counts.size)
    flags = styles.validity_classes(counts)
    yield Layer(group, "validity", "flags of every pixel", run.out / "validity.tif", place, run.shape, flags, True)
    unclear = styles.ramped(4, np.linspace(0, 1, len(styles.CIVIDIS)), styles.CIVIDIS)
    yield Layer(group, "confidence", BANDS[3].meaning, file, place, run.shape, unclear)
    width = run.out / "width.vrt"
    if run.config.interval:
        written.files[width] = styles.difference((file.name, 3, 2), place, run.shape)
        wide = styles.widths(1, upper - lower, unit="px")
        yield Layer(group, "interval width", "upper - lower bound, pixels", width, place, run.shape, wide, True)
    ramp = styles.colours(1, disparity, styles.VIRIDIS, unit="px")
    yield Layer(group, "disparity", BANDS[0].meaning, file, place, run.shape, ramp, True, True)


def _points(run: Run, written: Written) -> Iterator[Layer]:
    file = run.out / "points.tif"
    if not file.exists():
        return
    if not is_points_of(file, run.report["finished"]) or read_shape(file)[1:] != run.shape:
        written.notes.append(f"{file} belongs to another run and is left out: rerun sat-intervals triangulate")
        return
    place = run.georeferencing
    bands = read_small_layers(file, _fitting(run.shape))
    for number, ramp in ((6, styles.MAGMA), (3, styles.VIRIDIS)):
        name, is_height = POINTS[number - 1].name, number == 3
        renderer = styles.colours(number, bands[number - 1], ramp, unit="m")
        yield Layer(
            "Points", f"{name} of points", POINTS[number - 1].meaning, file, place, run.shape, renderer, is_height
        )


def _surface(run: Run, written: Written) -> Iterator[Layer]:
    file, group = run.out / "dsm.tif", "Heights"
    if not file.exists():
        return
    if not is_surface_of(file, run.report["finished"]) or not is_surface(file):
        written.notes.append(f"{file} is of another run or of earlier points and is left out: rerun sat-intervals dsm")
        return
    shape, place = read_place(file)
    bands = dict(zip((band.name for band in SURFACE), read_small_layers(file, _fitting(shape)), strict=True))
    half = run.out / "dsm_half_width.vrt"
    written.files[half] = styles.difference((file.name, 3, 2), place, shape, 0.5)
    wide = styles.widths(1, (bands["height_upper"] - bands["height_lower"]) / 2, unit="m")
    yield Layer(group, "half width", "half the width of the height's interval, m", half, place, shape, wide, True)
    unclear = styles.ramped(5, np.linspace(0, 1, len(styles.CIVIDIS)), styles.CIVIDIS)
    yield Layer(group, "confidence of heights", SURFACE[4].meaning, file, place, shape, unclear)
    ramp = styles.colours(1, bands["height"], styles.VIRIDIS, unit="m")
    yield Layer(group, "height", SURFACE[0].meaning, file, place, shape, ramp, True, True, _MULTIPLY)
    yield Layer(group, "hillshade", "shaded heights", file, place, shape, styles.hillshade(1), is_shown=True)


def _images(run: Run, written: Written) -> Iterator[Layer]:
    """Yield truth and images; those that cannot be opened, or were changed since the run, are left out."""
    names = ("truth", "left", "right") if run.truth_beside.exists() else ("left", "right")
    for name in names:
        try:
            image = open_input(run.report["inputs"]["left" if name == "truth" else name])
            if name == "truth":
                image = open_image(run.truth_beside, band=1)
            shape = image.height, image.width
            pixels = read_small_image(image, Window(0, 0, *shape), _fitting(shape))
        except SatIntervalsError as error:
            written.notes.append(f"the {name} image is left out: {error}")
            continue
        renderer = styles.grey(image.band, pixels)
        if name == "truth":
            renderer = styles.colours(1, pixels, styles.VIRIDIS, unit="px")
        yield Layer(
            "Images", name, f"{name} image", image.path, image.georeferencing, shape, renderer, is_shown=name == "left"
        )


def _fitting(shape: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of at most _LONGEST pixels."""
    step = -(-max(shape) // _LONGEST)
    return -(-shape[0] // step), -(-shape[1] // step)


def _project(run: Run, layers: list[Layer]) -> Element:
    """Return the project; the first layer is on top, and its CRS and extent are those of the map."""
    root = Element("qgis", version=styles.VERSION, projectname=run.out.resolve().name)
    SubElement(root, "title").text = run.out.resolve().name
    first = layers[0]
    _add_crs(SubElement(root, "projectCrs"), first.place)
    tree = SubElement(root, "layer-tree-group")
    groups: dict[str, Element] = {}
    listed = SubElement(root, "projectlayers")
    for layer in layers:
        if layer.group not in groups:
            groups[layer.group] = SubElement(tree, "layer-tree-group", name=layer.group, checked=_CHECKED, expanded="1")
        key = re.sub(r"\W", "_", f"{layer.group}_{layer.name}".lower())
        source = _relative(layer.source, run.out)
        SubElement(
            groups[layer.group],
            "layer-tree-layer",
            {"id": key, "name": layer.name, "source": source, "providerKey": "gdal", "expanded": "0"}
            | {"checked": _CHECKED if layer.is_shown else "Qt::Unchecked"},
        )
        _add_layer(listed, layer, key, source)
    canvas = SubElement(root, "mapcanvas", name="theMapCanvas")
    SubElement(canvas, "units").text = "meters"
    extent = SubElement(canvas, "extent")
    for name, value in zip(("xmin", "ymin", "xmax", "ymax"), _extent(first), strict=True):
        SubElement(extent, name).text = repr(value)
    _add_crs(SubElement(canvas, "destinationsrs"), first.place)
    properties = SubElement(root, "properties")
    SubElement(SubElement(properties, "Paths"), "Absolute", type="bool").text = "false"
    if first.place.crs:
        SubElement(SubElement(properties, "SpatialRefSys"), "ProjectionsEnabled", type="int").text = "1"
    return root


def _add_layer(listed: Element, layer: Layer, key: str, source: str) -> None:
    element = SubElement(listed, "maplayer", type="raster")
    for tag, text in (("id", key), ("datasource", source), ("layername", layer.name), ("provider", "gdal")):
        SubElement(element, tag).text = text
    SubElement(element, "abstract").text = layer.meaning
    _add_crs(SubElement(element, "srs"), layer.place)
    styles.add_style(element, layer.renderer, layer.blend)


def _add_crs(parent: Element, place: Georeferencing) -> None:
    crs = place.crs or place.gcps_crs
    system = SubElement(parent, "spatialrefsys")
    if crs:
        SubElement(system, "wkt").text = crs.to_wkt()
        if code := crs.to_epsg():
            SubElement(system, "authid").text = f"EPSG:{code}"


def _extent(layer: Layer) -> tuple[float, float, float, float]:
    """Return west, south, east, north of a layer; without georeferencing, QGIS counts rows downwards from 0."""
    height, width = layer.shape
    place = layer.place
    if place.transform is not None:
        a, b, c, d, e, f = place.transform[:6]
        ends = ((0, 0), (width, 0), (0, height), (width, height))
        corners = [(a * x + b * y + c, d * x + e * y + f) for x, y in ends]
    elif place.gcps:
        corners = [(point.x, point.y) for point in place.gcps]
    else:
        corners = [(0.0, float(-height)), (float(width), 0.0)]
    xs, ys = ([float(value) for value in values] for values in zip(*corners, strict=True))
    return min(xs), min(ys), max(xs), max(ys)


def _relative(source: str | Path, folder: Path) -> str:
    """Return a local file relative to the folder of the project, as QGIS writes it, and any other name as GDAL's."""
    name = str(source)
    if isinstance(source, str) and not Path(name).exists():
        return name.replace("s3://", "/vsis3/", 1) if name.startswith("s3://") else name
    relative = Path(os.path.relpath(Path(name).resolve(), folder.resolve())).as_posix()
    return relative if relative.startswith("../") else f"./{relative}"
