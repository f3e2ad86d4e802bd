"""Styles of rasters for QGIS: renderers, default styles (``.qml``), and virtual rasters of widths (``.vrt``)."""

from collections.abc import Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sat_intervals.products import FLAGS
from sat_intervals.raster import Georeferencing
from sat_intervals.show.legend import PIXEL_CLASSES, classify, limits, widest

# Colours at equal steps of matplotlib's maps.
VIRIDIS = "#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"
MAGMA = "#000004", "#51127c", "#b73779", "#fc8961", "#fcfdbf"
RDBU = "#67001f", "#d6604d", "#dddddd", "#4393c3", "#053061"
CIVIDIS = "#00224e", "#434e6c", "#7d7c78", "#bcaf6f", "#fee838"
# QGIS 3.22 is the oldest version the styles are tried with.
VERSION = "3.22.0"
HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
# Sun of the hillshade: north-west, 45 degrees high. Heights are flattened: noise of 0.1 m is steep between small cells.
_SUN = {"azimuth": "315", "angle": "45", "zfactor": "0.3", "multidirection": "0"}
CUT = 2.0  # share of values below the first and above the last colour, in percent


def colours(band: int, values: np.ndarray, ramp: Sequence[str], *, unit: str = "") -> Element:
    """Return a renderer that spreads colours from the 2nd to the 98th percentile of values; NaN are left out."""
    return _ramped(band, np.linspace(*limits(values, cut=CUT), len(ramp)), ramp, unit)


def shares(band: int) -> Element:
    """Return a renderer of values from 0 to 1."""
    return _ramped(band, np.linspace(0, 1, len(CIVIDIS)), CIVIDIS)


def widths(band: int, values: np.ndarray, *, unit: str) -> Element:
    """Return a renderer of widths from 0 to their 98th percentile; small ones get more colours, by square roots."""
    places = widest(values, CUT) * np.linspace(0, 1, len(MAGMA)) ** 2
    return _ramped(band, places, MAGMA, unit)


def diverging(band: int, end: float, *, unit: str = "") -> Element:
    """Return a renderer of changes, from red at minus ``end`` over grey to blue."""
    return _ramped(band, np.linspace(-end, end, len(RDBU)), RDBU, unit)


def _ramped(band: int, places: np.ndarray, ramp: Sequence[str], unit: str = "") -> Element:
    """Return a renderer that interpolates colours between values."""
    first, last = f"{places[0]:.6g}", f"{places[-1]:.6g}"
    renderer = _renderer("singlebandpseudocolor", band=band, classificationMin=first, classificationMax=last)
    ends = {"minimumValue": first, "maximumValue": last}
    kind = {"colorRampType": "INTERPOLATED", "classificationMode": "1", "clip": "0"}
    shader = SubElement(SubElement(renderer, "rastershader"), "colorrampshader", kind | ends)
    for place, colour in zip(places, ramp, strict=True):
        label = f"{place:.4g} {unit}".strip()
        SubElement(shader, "item", value=f"{place:.6g}", label=label, color=colour, alpha="255")
    return renderer


def grey(band: int, values: np.ndarray) -> Element:
    """Return a renderer of an image, from the 2nd to the 98th percentile of its values."""
    renderer = _renderer("singlebandgray", grayBand=band, gradient="BlackToWhite")
    stretch = SubElement(renderer, "contrastEnhancement")
    first, last = limits(values, cut=CUT)
    add_texts(stretch, minValue=f"{first:.6g}", maxValue=f"{last:.6g}", algorithm="StretchToMinimumMaximum")
    return renderer


def hillshade(band: int) -> Element:
    """Return a renderer of the shading of heights."""
    return _renderer("hillshade", band=band, **_SUN)


def validity_classes(counts: np.ndarray) -> Element:
    """Return a renderer of validity flags, with a label for each value that occurs; ``counts`` of all 65536 values."""
    renderer = _renderer("paletted", band=1)
    palette = SubElement(renderer, "colorPalette")
    present = np.flatnonzero(counts)
    classes = classify(present.astype(np.uint16))
    for place in np.lexsort((-counts[present], classes)):
        value, colour = int(present[place]), PIXEL_CLASSES[classes[place]].colour
        flags = [flag for flag in FLAGS if flag.value & value]
        # What makes a pixel invalid comes first.
        names = [flag.name for flag in flags if flag.invalid] or ["valid"]
        names += [flag.name for flag in flags if not flag.invalid]
        label = f"{value}: {', '.join(names).replace('_', ' ')} ({100 * counts[value] / counts.sum():.2g} %)"
        SubElement(palette, "paletteEntry", value=str(value), color=colour, label=label, alpha="255")
    return renderer


def _renderer(kind: str, **attributes: object) -> Element:
    given = {name: str(value) for name, value in attributes.items()}
    renderer = Element("rasterrenderer", {"type": kind, "opacity": "1", "alphaBand": "-1", "nodataColor": ""} | given)
    SubElement(renderer, "rasterTransparency")
    return renderer


def add_style(parent: Element, renderer: Element, blend: int) -> None:
    """Add a renderer to a style or a layer, drawn over what is below with one of QGIS' blend modes; 0 = normal."""
    pipe = SubElement(parent, "pipe")
    pipe.append(renderer)
    SubElement(pipe, "brightnesscontrast", brightness="0", contrast="0", gamma="1")
    SubElement(pipe, "rasterresampler", maxOversampling="2")
    SubElement(parent, "blendMode").text = str(blend)


def default_style(renderer: Element) -> bytes:
    """Return the default style of the raster beside it."""
    root = Element("qgis", version=VERSION, styleCategories="Symbology")
    add_style(root, renderer, 0)
    return text_of(root, HEAD)


def difference(
    source: tuple[str, int, int], place: Georeferencing, shape: tuple[int, int], factor: float = 1.0
) -> bytes:
    """Return a virtual raster of the difference of two bands, times a factor.

    ``source`` is the name of a raster beside it, the band to subtract from, and that to subtract, counted from 1.
    """
    name, upper, lower = source
    root = Element("VRTDataset", rasterXSize=str(shape[1]), rasterYSize=str(shape[0]))
    _add_place(root, place)
    band = SubElement(root, "VRTRasterBand", dataType="Float32", band="1", subClass="VRTDerivedRasterBand")
    add_texts(band, NoDataValue="nan", PixelFunctionType="diff", SourceTransferType="Float32")
    for number in (upper, lower):
        of_band = SubElement(band, "ComplexSource")
        SubElement(of_band, "SourceFilename", relativeToVRT="1").text = name
        add_texts(of_band, SourceBand=str(number), ScaleOffset="0", ScaleRatio=f"{factor:g}")
    return text_of(root)


def _add_place(root: Element, place: Georeferencing) -> None:
    if place.transform is not None:
        SubElement(root, "GeoTransform").text = ", ".join(map(repr, place.transform.to_gdal()))
    elif place.gcps:
        points = SubElement(root, "GCPList", Projection=place.gcps_crs.to_wkt() if place.gcps_crs else "")
        for row, column, x, y, z in place.gcps:
            at = {"Pixel": column, "Line": row, "X": x, "Y": y, "Z": z}
            SubElement(points, "GCP", {key: repr(float(value)) for key, value in at.items()})
    if place.crs:
        SubElement(root, "SRS", dataAxisToSRSAxisMapping="1,2").text = place.crs.to_wkt()
    if place.rpcs is not None:
        rpcs = SubElement(root, "Metadata", domain="RPC")
        for key, value in place.creation_options()["rpcs"].items():
            SubElement(rpcs, "MDI", key=key).text = str(value)


def add_texts(parent: Element, **texts: str) -> None:
    """Add an element with a text for each name."""
    for name, text in texts.items():
        SubElement(parent, name).text = text


def text_of(root: Element, head: str = "") -> bytes:
    """Return XML as the content of a file."""
    ElementTree.indent(root, " ")
    return (head + ElementTree.tostring(root, encoding="unicode") + "\n").encode()
