"""Edit a register's rows as somebody does in QGIS, in ten ways, and leave them open until stdin ends.

usage: QT_QPA_PLATFORM=offscreen PYTHON_OF_QGIS edit_in_qgis.py FILE

It runs with the Python that QGIS is installed for.
"""

import os
import sys

from qgis.core import QgsApplication, QgsFeature, QgsFeatureRequest, QgsGeometry, QgsPointXY, QgsVectorLayer
from qgis.PyQt.QtCore import QDate

application = QgsApplication([], GUIenabled=False)
application.initQgis()
layer = QgsVectorLayer(f"{sys.argv[1]}|layername=rows", "rows", "ogr")


def named(label):
    return next(layer.getFeatures(QgsFeatureRequest().setFilterExpression(f"label = '{label}'")))


def say(label, column, value):
    layer.changeAttributeValue(named(label).id(), layer.fields().indexOf(column), value)


layer.startEditing()
row = named("1 F")
first = row.geometry().vertexAt(0)
layer.moveVertex(first.x() - 2, first.y(), row.id(), 0)
row = named("2 F")
moved = row.geometry()
moved.translate(0, 0.3)
layer.changeGeometry(row.id(), moved)
row = named("3 F")
box = row.geometry().boundingBox()
layer.selectByIds([row.id()])
layer.splitFeatures([QgsPointXY(box.xMinimum() + 9, y) for y in (box.yMinimum() - 1, box.yMaximum() + 1)])
layer.deleteFeature(named("4 F").id())
say("5 F", "label", "Barbera")
drawn = QgsFeature(layer.fields())
drawn.setGeometry(QgsGeometry.fromWkt("LINESTRING(428000 4940015, 428030 4940016)"))
layer.addFeature(drawn)
row = named("1 G")
layer.changeGeometry(row.id(), QgsGeometry.fromPolylineXY(row.geometry().asPolyline()[::-1]))
say("2 G", "row_id", 22)
say("3 G", "label", "4 G")
say("5 G", "grubbed", QDate(2026, 6, 20))
saved = layer.commitChanges()
sys.stdout.write("saved\n" if saved else f"{layer.commitErrors()}\n")
sys.stdout.flush()
sys.stdin.read()  # it stays open until somebody closes it
os._exit(0)  # leaving in the usual way may crash
