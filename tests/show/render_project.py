"""Run by the system's Python with QGIS: load a project, print its layers as JSON, render them to PNG files.

Usage: render_project.py PROJECT PICTURES; PICTURES/map.png has the layers that are switched on, the others one each.
"""

import json
import sys
from pathlib import Path

from qgis.core import QgsApplication, QgsMapRendererParallelJob, QgsMapSettings, QgsProject, QgsRasterLayer
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor

project_file, pictures = sys.argv[1], Path(sys.argv[2])
application = QgsApplication([], False)
application.initQgis()
project = QgsProject.instance()
is_read = project.read(project_file)
tree = project.layerTreeRoot()


def render(layers, name):
    settings = QgsMapSettings()
    settings.setLayers(layers)
    settings.setDestinationCrs(layers[0].crs())
    settings.setExtent(layers[0].extent())
    settings.setOutputSize(QSize(700, 700))
    settings.setBackgroundColor(QColor("white"))
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    job.renderedImage().save(str(pictures / f"{name}.png"))


def described(place):
    layer = place.layer()
    renderer = layer.renderer()
    alone = QgsRasterLayer(layer.source(), "alone", "gdal")  # takes the default style, if there is one
    return {
        "name": layer.name(),
        "group": place.parent().name(),
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "renderer": renderer and renderer.type(),
        "bands": renderer and list(renderer.usesBands()),
        "blend": int(layer.blendMode()),
        "shown": place.itemVisibilityChecked(),
        "source": layer.source(),
        "labels": [label for label, _ in renderer.legendSymbologyItems()] if renderer else [],
        "alone": alone.renderer().type(),
        "alone_labels": [label for label, _ in alone.renderer().legendSymbologyItems()],
    }


places = tree.findLayers()
print(json.dumps({"read": is_read, "crs": project.crs().authid(), "layers": [described(place) for place in places]}))
render([place.layer() for place in places if place.itemVisibilityChecked()], "map")
for place in places:
    render([place.layer()], place.layer().name().replace(" ", "_"))
application.exitQgis()
