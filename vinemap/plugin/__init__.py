"""The plugin that calls ``vinemap`` from QGIS, in ``qgis``, and what puts it where QGIS finds it.

QGIS runs the plugin in its own Python, which has no vinemap: nothing in ``qgis`` imports any other room.
"""
