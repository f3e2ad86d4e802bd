"""Write a QGIS project of a finished run, with the default styles of its rasters. QGIS is not needed."""

import os
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from logging import getLogger
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import BANDS, CHANGE, SURFACE, SURFACE_OF_SWEEP
from sat_intervals.raster import Georeferencing, RemotePath, open_image, path_of, read_layers, read_place
from sat_intervals.raster.publishing import write_file
from sat_intervals.raster.windows import read_small_image, read_small_layers
from sat_intervals.results import Run, open_input, open_run, read_change
from sat_intervals.show import styles
from sat_intervals.show.legend import widest
from sat_intervals.tiling import Window

_LONGEST = 1024  # pixels, longest side of what percentiles are taken from
_MULTIPLY = 6  # QGIS' blend mode
_HEIGHT = "height"  # the layer that is the terrain of 3D views
_CHECKED = "Qt::Checked"
_PROJECT = "project.qgz"
_STYLED = "intervals", "width", "validity", "dsm", "dsm_half_width", "ortho"  # rasters with a default style

_LOG = getLogger(__name__)


@dataclass(frozen=True)
class Raster:
    """A file or GDAL name, its place and size; ``virtual`` is its content if the project makes it."""

    source: str | Path
    place: Georeferencing
    shape: tuple[int, int]
    virtual: bytes = b""


@dataclass(frozen=True)
class ProjectLayer:
    """A layer of the project: group, name and meaning in the list, its raster, and colours."""

    group: str
    name: str
    meaning: str
    raster: Raster
    renderer: Element
    is_default: bool = False  # the raster alone gets this style, too
    is_shown: bool = False
    blend: int = 0  # QGIS' mode over the layers below


def write_project(out: str | Path) -> list[Path]:
    """Write ``project.qgz`` to the folder of a finished run, and the default styles of its rasters; return the files.

    The project has the images and the truth, disparity, interval width, confidence and validity; if ``dsm.tif`` is
    of this run, also its heights and ortho-image, and what is on no map is switched off. Of a sweep of many images it
    has heights, ortho-image and validity, of a folder of `change` the change of height. Paths in it are relative where
    the files are local.
    """
    if read_change(out):
        return _write(path_of(out), [*_change(path_of(out))])
    run = open_run(out)
    names = (f"{name}{end}" for name in _STYLED for end in (".qml", ".vrt"))
    run.check_kept([run.out / name for name in (_PROJECT, *names)])
    surface, layers = [*_surface(run)], [*_results(run), *_images(run)]
    if surface and not run.georeferencing.crs:
        layers = [replace(layer, is_shown=False) for layer in layers]
    return _write(run.out, [*surface, *layers])


def _write(out: Path, layers: list[ProjectLayer]) -> list[Path]:
    """Write a project of layers, virtual rasters and styles; return the files."""
    written = {path_of(layer.raster.source): layer.raster.virtual for layer in layers if layer.raster.virtual}
    for layer in layers:
        if layer.is_default:
            written[path_of(layer.raster.source).with_suffix(".qml")] = styles.default_style(layer.renderer)
    content = BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        root = _project(out, layers)
        archive.writestr(zipfile.ZipInfo("project.qgs"), styles.text_of(root, styles.HEAD))
    written[out / _PROJECT] = content.getvalue()
    for path, text in written.items():
        write_file(path, text)
    return list(written)


def _results(run: Run) -> Iterator[ProjectLayer]:
    group = "Heights" if run.is_sweep else "Disparity"
    shape = run.shape
    place = run.georeferencing
    validity = Raster(run.out / "validity.tif", place, shape)
    counts = np.zeros(1 << 16, np.int64)
    for window in run.windows():
        counts += np.bincount(read_layers(validity.source, window).ravel(), minlength=counts.size)
    yield ProjectLayer(group, "validity", "flags of every pixel", validity, styles.validity_classes(counts), True)
    if run.is_sweep:
        return
    intervals = Raster(run.out / "intervals.tif", place, shape)
    disparity, lower, upper, *_ = read_small_layers(intervals.source, _fitting(shape))
    yield ProjectLayer(group, "confidence", BANDS[3].meaning, intervals, styles.shares(4))
    if run.config.interval:
        width = Raster(run.out / "width.vrt", place, shape, styles.difference(("intervals.tif", 3, 2), place, shape))
        wide = styles.widths(1, upper - lower, unit="px")
        yield ProjectLayer(group, "interval width", "upper - lower bound, pixels", width, wide, True)
    ramp = styles.colours(1, disparity, styles.VIRIDIS, unit="px")
    yield ProjectLayer(group, "disparity", BANDS[0].meaning, intervals, ramp, True, True)


def _surface(run: Run) -> Iterator[ProjectLayer]:
    if not run.has_current("dsm.tif"):
        return
    group, file = "Heights", run.out / "dsm.tif"
    shape, place = read_place(file)
    surface = Raster(file, place, shape)
    half = Raster(run.out / "dsm_half_width.vrt", place, shape, styles.difference((file.name, 3, 2), place, shape, 0.5))
    height, lower, upper, *_ = read_small_layers(file, _fitting(shape))
    meanings = {band.name: band.meaning for band in (SURFACE_OF_SWEEP if run.is_sweep else SURFACE)}
    wide = styles.widths(1, (upper - lower) / 2, unit="m")
    yield ProjectLayer(group, "half width", "half the width of the height's interval, m", half, wide, True)
    yield ProjectLayer(group, "confidence of heights", meanings["confidence"], surface, styles.shares(5))
    ramp = styles.colours(1, height, styles.VIRIDIS, unit="m")
    ortho = run.ortho
    yield ProjectLayer(group, _HEIGHT, meanings["height"], surface, ramp, True, not ortho, _MULTIPLY)
    if ortho:
        grey = styles.grey(1, read_small_layers(ortho, _fitting(shape))[0])
        yield ProjectLayer(group, "ortho-image", "image on the surface", Raster(ortho, place, shape), grey, True, True)
    yield ProjectLayer(group, "hillshade", "shaded heights", surface, styles.hillshade(1), is_shown=True)


def _change(out: Path) -> Iterator[ProjectLayer]:
    """Yield the layers of a change of height."""
    file = out / "change.tif"
    shape, place = read_place(file)
    raster, (difference, *_, change) = Raster(file, place, shape), read_small_layers(file, _fitting(shape))
    end = widest(np.abs(difference[np.abs(change) == 1]), styles.CUT)
    names = {band.name: band.meaning for band in CHANGE}
    for number, name, renderer in (
        (5, "change", styles.diverging(5, 1.0)),
        (4, "significance", styles.shares(4)),
        (1, "difference", styles.diverging(1, end, unit="m")),
    ):
        yield ProjectLayer("Change", name, names[name], raster, renderer, number == 1, number == 5)


def _images(run: Run) -> Iterator[ProjectLayer]:
    """Yield truth and images; those that cannot be opened are left out, and raw ones, which are on no map."""
    if run.is_sweep:
        return
    for name in ("truth", "left", "right") if run.truth_beside.exists() else ("left", "right"):
        try:
            image = open_input(run.report["inputs"]["left" if name == "truth" else name])
            if name == "truth":
                image = open_image(run.truth_beside, band=1)
            shape = image.height, image.width
            pixels = read_small_image(image, Window(0, 0, *shape), _fitting(shape))
        except SatIntervalsError as error:
            _LOG.warning("the %s image is left out: %s", name, error)
            continue
        renderer = styles.grey(image.band, pixels)
        if name == "truth":
            renderer = styles.colours(1, pixels, styles.VIRIDIS, unit="px")
        raster = Raster(image.path, image.georeferencing, shape)
        yield ProjectLayer("Images", name, f"{name} image", raster, renderer, is_shown=name == "left")


def _fitting(shape: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of at most _LONGEST pixels."""
    step = -(-max(shape) // _LONGEST)
    return -(-shape[0] // step), -(-shape[1] // step)


def _project(out: Path, layers: list[ProjectLayer]) -> Element:
    """Return the project; the first layer is on top, and its CRS and extent are those of the map."""
    root = Element("qgis", version=styles.VERSION, projectname=out.resolve().name)
    SubElement(root, "title").text = out.resolve().name
    first = layers[0].raster
    _add_crs(SubElement(root, "projectCrs"), first.place)
    tree = SubElement(root, "layer-tree-group")
    groups: dict[str, Element] = {}
    listed = SubElement(root, "projectlayers")
    for layer in layers:
        if layer.group not in groups:
            groups[layer.group] = SubElement(tree, "layer-tree-group", name=layer.group, checked=_CHECKED, expanded="1")
        key = re.sub(r"\W", "_", f"{layer.group}_{layer.name}".lower())
        source = _relative(layer.raster.source, out)
        about = {"id": key, "name": layer.name, "source": source, "providerKey": "gdal", "expanded": "0"}
        about["checked"] = _CHECKED if layer.is_shown else "Qt::Unchecked"
        SubElement(groups[layer.group], "layer-tree-layer", about)
        _add_layer(listed, layer, key, source)
        if layer.name == _HEIGHT:
            terrain = SubElement(SubElement(root, "ElevationProperties"), "terrainProvider", type="raster")
            given = {"layer": key, "layerName": layer.name, "layerSource": source, "layerProvider": "gdal"}
            SubElement(terrain, "TerrainProvider", given, offset="0", scale="1")
    canvas = SubElement(root, "mapcanvas", name="theMapCanvas")
    styles.add_texts(canvas, units="meters")
    styles.add_texts(SubElement(canvas, "extent"), **_extent(first))
    _add_crs(SubElement(canvas, "destinationsrs"), first.place)
    properties = SubElement(root, "properties")
    SubElement(SubElement(properties, "Paths"), "Absolute", type="bool").text = "false"
    if first.place.crs:
        SubElement(SubElement(properties, "SpatialRefSys"), "ProjectionsEnabled", type="int").text = "1"
    return root


def _add_layer(listed: Element, layer: ProjectLayer, key: str, source: str) -> None:
    element = SubElement(listed, "maplayer", type="raster")
    styles.add_texts(element, id=key, datasource=source, layername=layer.name, provider="gdal", abstract=layer.meaning)
    _add_crs(SubElement(element, "srs"), layer.raster.place)
    styles.add_style(element, layer.renderer, layer.blend)


def _add_crs(parent: Element, place: Georeferencing) -> None:
    crs = place.crs or place.gcps_crs
    system = SubElement(parent, "spatialrefsys")
    if crs:
        SubElement(system, "wkt").text = crs.to_wkt()
        if code := crs.to_epsg():
            SubElement(system, "authid").text = f"EPSG:{code}"


def _extent(raster: Raster) -> dict[str, str]:
    """Return the extent of a raster; without georeferencing, QGIS counts rows downwards from 0."""
    height, width = raster.shape
    place = raster.place
    if place.transform is not None:
        a, b, c, d, e, f = place.transform[:6]
        ends = ((0, 0), (width, 0), (0, height), (width, height))
        corners = [(a * x + b * y + c, d * x + e * y + f) for x, y in ends]
    elif place.gcps:
        corners = [(point.x, point.y) for point in place.gcps]
    else:
        corners = [(0.0, -height), (width, 0.0)]
    xs, ys = zip(*corners, strict=True)
    extent = {"xmin": min(xs), "ymin": min(ys), "xmax": max(xs), "ymax": max(ys)}
    return {name: repr(float(value)) for name, value in extent.items()}


def _relative(source: str | Path, folder: Path) -> str:
    """Return a local file relative to the folder of the project, as QGIS writes it, and any other name as GDAL's."""
    name, path = str(source), path_of(source)
    if isinstance(path, RemotePath):
        return path.gdal_name
    if isinstance(source, str) and not path.exists():
        return name
    if isinstance(folder, RemotePath):
        return str(path.resolve())
    relative = Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    return relative if relative.startswith("../") else f"./{relative}"
